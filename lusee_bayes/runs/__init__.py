"""One function for each command: it computes, and writes its folder completely or not at all."""
