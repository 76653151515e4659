"""The learning rate as a function of progress through the schedule."""

from __future__ import annotations

import math

from geomoe3d.training.config import OptimizerConfig


def learning_rate(config: OptimizerConfig, progress: float) -> float:
    """Rate at ``progress`` in [0, 1].

    ``exponential``: level until ``decay_start``, then falling by a constant factor to ``final_ratio``; the
    defaults are the published x0.999996 per iteration from 80k of 500k. ``cosine``: half a cosine from the
    warm-up to ``final_ratio``. ``one_cycle``: up over 30 % of the schedule (or ``warmup`` if larger) from
    1/25, then half a cosine down. ``constant``: level after the warm-up.
    """
    peak = config.learning_rate
    if config.schedule == "one_cycle":
        rise = max(config.warmup, 0.3)
        if progress < rise:
            return peak * (0.04 + 0.96 * 0.5 * (1 - math.cos(math.pi * progress / rise)))
        return peak * _cosine((progress - rise) / (1 - rise), config.final_ratio)
    if progress < config.warmup:
        return peak * max(progress / config.warmup, 1e-3)
    if config.schedule == "cosine":
        return peak * _cosine((progress - config.warmup) / (1 - config.warmup), config.final_ratio)
    if config.schedule == "exponential" and progress > config.decay_start:
        along = (progress - config.decay_start) / (1 - config.decay_start)
        return float(peak * config.final_ratio ** min(along, 1.0))
    return peak


def _cosine(along: float, final_ratio: float) -> float:
    return final_ratio + (1 - final_ratio) * 0.5 * (1 + math.cos(math.pi * min(along, 1.0)))
