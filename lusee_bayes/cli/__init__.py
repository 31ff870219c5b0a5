"""The command line: parse, call one run, print."""
