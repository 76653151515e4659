"""A scorer of your own: scans that were taken one after the other, from places not far apart.

geomoe3d register source.ply target.ply --scorer surfaces --scorer network --scorer examples/scorer.py:Near
"""

from dataclasses import dataclass

import numpy as np

from geomoe3d.scoring.base import Belief, Scorer


@dataclass(frozen=True)
class Near(Scorer):
    """Believes less in a transform the farther it puts one sensor from the other.

    Attributes:
        reach: distance up to which it believes, in the clouds' unit; beyond it falls by e per reach.
    """

    reach: float = 4.0

    def about(self, pair):
        source, target = pair.clouds
        sensors = [np.zeros(3) if cloud.viewpoint is None else cloud.viewpoint for cloud in (source, target)]

        def say(transforms):
            places = transforms[:, :3, :3] @ sensors[0] + transforms[:, :3, 3]
            beyond = np.linalg.norm(places - sensors[1], axis=1) / self.reach - 1
            return [Belief(float(np.exp(-max(far, 0)))) for far in beyond]

        return say
