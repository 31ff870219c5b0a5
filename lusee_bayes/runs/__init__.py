"""One function for each command: it computes, and writes its folder whole or not at all."""
