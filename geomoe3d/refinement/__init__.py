"""Transforms polished on the clouds."""
