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
# # Two scans of one room
#
# A script that is a notebook too: run it with `python examples/two_scans.py`, open it in an editor that knows
# cells, or make a notebook of it with `jupytext --to ipynb examples/two_scans.py`. It writes into the folder at work.

# %%
import numpy as np

import geomoe3d
from geomoe3d.data.sample import write_sample_pair

paths = write_sample_pair("sample", force=True)
result = geomoe3d.register(paths.source, paths.target)
result  # noqa: B018  a notebook shows the status here, and the clouds to be turned

# %% [markdown]
# Look at `ok` before using the transform, p_target = R p_source + t.

# %%
assert result.ok, result.reasons
moved = result.apply(geomoe3d.load_points(paths.source).file_points)
print(moved.shape, result.accuracy)

# %% [markdown]
# Before, after, what was matched, and how far off: one picture, and one sheet of paper.

# %%
result.picture("two_scans.png", unit="m", force=True)
result.report("two_scans.pdf", unit="m", force=True)

# %% [markdown]
# Scans that have nothing to do with each other are not forced together: here the target and a heap of noise.

# %%
noise = np.random.default_rng(0).uniform(-2, 2, (20_000, 3))
unrelated = geomoe3d.register(noise, paths.target)
print(unrelated)
assert not unrelated.ok
