"""Scored hypotheses to an answer: selection, confidence, result."""
