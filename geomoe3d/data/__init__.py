"""Where clouds come from besides the user's files."""
