"""What a person looks at: figures, pages, and what is in a file."""
