"""The reference paper: its cases, its claims and its figures."""
