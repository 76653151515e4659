"""Rigid motions and how to fit them; knows nothing of clouds or files."""
