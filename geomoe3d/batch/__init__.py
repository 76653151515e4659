"""Many pairs: a table in, one result per pair out, resumable, on one machine or on a cluster."""
