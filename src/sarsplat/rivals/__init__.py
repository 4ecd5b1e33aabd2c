"""Methods of others under one interface, implemented afresh, to be compared with ours on the same data."""
