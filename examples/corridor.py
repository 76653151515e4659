# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A corridor: when more than one transform fits
#
# Two stretches of a plain corridor can slide along each other. No program can know how far; this one says so.
# With a cupboard in view the shift is found. Runs as a script, and as a notebook by jupytext.

# %%
import numpy as np

import geomoe3d

rng = np.random.default_rng(0)


def corridor(begin: float, cupboard: bool) -> np.ndarray:
    """Points of ten metres of corridor, 2 m wide and 2.5 m high, as a scanner in its middle sees them."""
    x = rng.uniform(begin, begin + 10, 30_000)
    around = rng.uniform(0, 9, len(x))  # once around the walls
    y = np.select([around < 2, around < 4.5, around < 6.5], [around - 1, 1.0 + 0 * x, 5.5 - around], -1.0)
    z = np.select([around < 2, around < 4.5, around < 6.5], [0 * x, around - 2, 2.5 + 0 * x], 9 - around)
    points = np.stack([x, y, z], axis=1)
    if cupboard:
        u, v, w = rng.uniform(0, 1, (3, 3_000))
        side = rng.integers(0, 3, 3_000)  # its ends, its front, its top
        box = [np.where(side == 0, np.round(u), u), np.where(side == 1, 0, v), np.where(side == 2, 1, w)]
        points = np.concatenate([points, np.transpose(box) * [1.0, 0.6, 1.9] + [6.0, 0.4, 0.0]])
    return points + rng.normal(0, 0.005, points.shape) - [begin + 5, 0, 1.2]


# %%
plain = geomoe3d.register(corridor(0, False), corridor(4, False))
print(plain)
assert plain.status == "ambiguous"

# %% [markdown]
# The reason names what is missing. The page and the picture of such an answer show the alternative too.

# %%
furnished = geomoe3d.register(corridor(0, True), corridor(4, True))
print(furnished)
assert abs(np.linalg.norm(furnished.T_target_source[:3, 3]) - 4) < 0.1

# %%
plain.picture("corridor.png", unit="m", force=True)
