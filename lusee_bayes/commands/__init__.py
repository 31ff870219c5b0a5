"""What each command does: scenario in, files and a few figures out."""
