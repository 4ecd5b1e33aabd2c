"""Methods of others, written afresh, that learn from the same data: to be compared with."""
