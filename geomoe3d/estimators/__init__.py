"""From correspondences (N, 6) with optional weights to candidate rigid motions.

Every estimator has one form (`base.Estimator`) and can be used alone on anybody's correspondences.
"""
