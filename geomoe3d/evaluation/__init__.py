"""Evaluation in the field's terms: predict once into a cache, score as often as one likes."""
