"""What runs have found, as objects and as files."""
