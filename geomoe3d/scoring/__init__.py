"""Hypotheses to scores: what the clouds and a network say of a transform."""
