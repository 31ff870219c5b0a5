"""Basics for all other folders: checks, harmonics, rotations, linear algebra, files, progress."""
