"""What every other folder needs: checks, harmonics, rotations, linear algebra, files, progress."""
