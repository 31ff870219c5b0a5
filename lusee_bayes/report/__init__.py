"""Output for readers: figures, pages, and descriptions of files."""
