"""Files that are there whole or not at all, arrays in them, and the journal of a long run."""
