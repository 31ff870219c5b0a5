"""Sessions of the spectrometer, as luseepy's ``lusee.ingest`` writes them, and their reduction.

From counts to V^2/Hz: :mod:`.session_files` reads files, :mod:`.gain_model` calibrates,
:mod:`.bands` averages over channels, :mod:`.flags` detects disturbances, :mod:`.reduction` does all
of it for files of any length, :mod:`.reduced` is the result, whose bands are visibilities.
:mod:`.synthesis` simulates sessions.
"""
