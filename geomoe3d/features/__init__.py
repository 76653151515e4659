"""Preprocessed clouds to features: descriptors, and their cache on disk."""
