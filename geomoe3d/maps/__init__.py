"""A large cloud described once, and small scans found in it."""
