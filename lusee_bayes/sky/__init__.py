"""The sky: the embedded Galaxy and its sources, and skies read from files."""
