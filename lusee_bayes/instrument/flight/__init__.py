"""Sessions of the spectrometer, as luseepy's ``lusee.ingest`` writes them, and what they become.

From counts to V^2/Hz: :mod:`.sessions` reads files, :mod:`.gain_table` calibrates, :mod:`.lines`
and :mod:`.bursts` flag, :mod:`.band` averages over channels, :mod:`.reduction` does all of it for
files of any length, :mod:`.reduced` is the result.
"""
