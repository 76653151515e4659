"""Pairs drawn fresh from fragments with features: new keypoints, new matches, every time.

Index k of a pool always gives the same pair of the same keypoints, and there is no end of indices, so no
epoch repeats the matches of another. `geomoe3d.training.fragment_pairs` makes them a training data set.
A pair is chosen by overlap band first, so that hard pairs come as often as is wanted. About 8 ms per pair
of 1,000 keypoints on one core.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from geomoe3d.config import MatchingConfig, Section
from geomoe3d.data.shards import DescribedScene, open_shard, read_meta, shard_folders
from geomoe3d.errors import InputError
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.matching.nearest import match
from geomoe3d.types import BoolArray, Correspondences, FloatArray, PreparedCloud


class DrawSettings(Section):
    """Which pairs are drawn, and how."""

    keypoints: tuple[int, int] = Field(
        (250, 5000), description="range of keypoints per fragment, drawn log-uniformly around the usual"
    )
    usual_keypoints: int = Field(1000, ge=3, description="keypoints of most pairs")
    usual_share: float = Field(0.7, ge=0, le=1, description="share of pairs with the usual keypoints")
    whole_share: float = Field(
        0.0,
        ge=0,
        le=1,
        description="share of pairs for which all points are matched and whole_kept matches kept",
    )
    whole_kept: int = Field(
        1000, ge=3, description="matches kept of those, mutual ones first, as registration does"
    )
    bands: tuple[float, ...] = Field((0.1, 0.3, 0.6, 1.01), description="edges of the overlap bands")
    band_shares: tuple[float, ...] = Field((0.4, 0.4, 0.2), description="how often each band is drawn")
    min_inliers: int = Field(3, ge=0, description="pairs with fewer true matches are drawn again")
    inlier_threshold: float = Field(2.0, gt=0, description="largest residual of a true match, in voxels")

    @model_validator(mode="after")
    def _check(self) -> DrawSettings:
        if not 3 <= self.keypoints[0] <= self.keypoints[1]:
            raise ValueError("keypoints must be a range [low, high] with 3 <= low <= high")
        if len(self.bands) != len(self.band_shares) + 1 or list(self.bands) != sorted(self.bands):
            raise ValueError("bands must rise and have one edge more than there are band_shares")
        if not sum(self.band_shares) > 0 or min(self.band_shares) < 0:
            raise ValueError("band_shares must not be negative and not all zero")
        return self


PROTOCOL = DrawSettings(usual_share=1.0, band_shares=(1.0,), bands=(0.0, 1.01), min_inliers=0)
"""1,000 keypoints of every pair, as the fixed correspondences of the benchmark."""


@dataclass(frozen=True)
class DrawnPair:
    """Matches of one pair of fragments with what is true about them.

    Attributes:
        correspondences: (N,) nearest neighbours of the keypoints, source to target, metres.
        labels: (N,) True where the residual under the true motion is below the inlier threshold.
        T_target_source: (4, 4) true motion.
        voxel_size: metres.
        whole: True where all points were matched and the mutual matches taken first.
    """

    correspondences: Correspondences
    labels: BoolArray
    T_target_source: FloatArray
    voxel_size: float
    whole: bool = False


class FragmentPool:
    """Pairs of all shards of a folder, without end.

    Args:
        folder: of shards that `data features` made.
        settings: None takes the defaults.
        seed: another seed draws other pairs and keypoints.
        verify: True compares the hashes of all shards first.

    Raises:
        InputError: no shards, or none of their pairs lies in a band.
        FormatError: a shard is damaged or of another version.
    """

    def __init__(
        self, folder: str | Path, settings: DrawSettings | None = None, seed: int = 0, *, verify: bool = False
    ) -> None:
        self.folder = Path(folder)
        self.settings = settings or DrawSettings()
        self.seed = seed
        self._paths = shard_folders(self.folder)
        self._open: dict[int, DescribedScene] = {}
        overlaps, owners, places, voxels = [], [], [], []
        for number, path in enumerate(self._paths):
            scene = open_shard(path, verify=verify)
            overlaps.append(np.array(scene.overlap))
            owners.append(np.full(len(scene.pair), number))
            places.append(np.arange(len(scene.pair)))
            voxels.append(scene.voxel_size)
        self.voxel_sizes = min(voxels), max(voxels)
        self.overlap = np.concatenate(overlaps)
        self._owner, self._place = np.concatenate(owners), np.concatenate(places)
        edges = self.settings.bands
        self._bands = [
            np.flatnonzero((self.overlap >= low) & (self.overlap < high))
            for low, high in itertools.pairwise(edges)
        ]
        shares = np.array(self.settings.band_shares) * [len(band) > 0 for band in self._bands]
        if not shares.sum() > 0:
            raise InputError(f"'{self.folder}' holds no pair with an overlap in the bands {edges}")
        self._shares = shares / shares.sum()

    @property
    def num_pairs(self) -> int:
        """Distinct pairs of fragments."""
        return len(self.overlap)

    def __len__(self) -> int:
        # Stands for: without end.
        return 2**40

    def __getitem__(self, index: int) -> DrawnPair:
        if not 0 <= index < len(self):
            raise IndexError(f"pair {index} of {len(self)}")
        rng = np.random.default_rng([self.seed, 3, index])
        pair = None
        tries = 4
        for attempt in range(2 * tries):
            if attempt % tries == 0:  # another pair only when fresh keypoints did not help
                band = self._bands[int(rng.choice(len(self._bands), p=self._shares))]
                chosen = int(band[rng.integers(len(band))])
            pair = self.draw(chosen, rng)
            if int(pair.labels.sum()) >= self.settings.min_inliers:
                break
        assert pair is not None
        return pair

    def draw(self, number: int, rng: np.random.Generator, keypoints: int | None = None) -> DrawnPair:
        """Fresh correspondences of one pair of fragments.

        Args:
            number: 0 <= number < num_pairs.
            rng: decides roles and keypoints.
            keypoints: per fragment, fewer where it has fewer; None draws the number.
        """
        scene = self._scene(int(self._owner[number]))
        place = int(self._place[number])
        i, j = (int(k) for k in scene.pair[place])
        share = self.settings.whole_share
        whole = keypoints is None and share > 0 and rng.random() < share
        count = keypoints if keypoints is not None else 2**30 if whole else self._count(rng)
        return draw_pair(
            scene.fragment(i),
            scene.fragment(j),
            np.array(scene.T_target_source[place]),
            scene.voxel_size,
            count,
            self.settings.inlier_threshold,
            rng,
            self.settings.whole_kept if whole else None,
        )

    def identity(self) -> str:
        """Changes with the shards, the settings and the seed."""
        digest = hashlib.sha256(self.settings.model_dump_json().encode())
        for path in self._paths:
            digest.update(json.dumps([path.name, read_meta(path)["sha256"]], sort_keys=True).encode())
        return f"fragments:{self.folder.name}:{self.num_pairs}:{self.seed}:{digest.hexdigest()[:12]}"

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": {}}  # workers map the files themselves

    def _scene(self, number: int) -> DescribedScene:
        if number not in self._open:
            self._open[number] = open_shard(self._paths[number])
        return self._open[number]

    def _count(self, rng: np.random.Generator) -> int:
        if rng.random() < self.settings.usual_share:
            return self.settings.usual_keypoints
        low, high = np.log(self.settings.keypoints)
        return round(float(np.exp(rng.uniform(low, high))))


def draw_pair(
    source: tuple[Any, Any],
    target: tuple[Any, Any],
    T_target_source: FloatArray,
    voxel_size: float,
    keypoints: int,
    inlier_threshold: float,
    rng: np.random.Generator,
    kept: int | None = None,
) -> DrawnPair:
    """Nearest neighbours of random keypoints, source to target, with their labels.

    Args:
        source: (n, 3) points and (n, 33) features.
        target: the same of the target.
        T_target_source: (4, 4) true motion.
        voxel_size: cloud units.
        keypoints: drawn without replacement in each cloud; all where it has fewer.
        inlier_threshold: in voxels.
        rng: decides the keypoints, and which matches are kept.
        kept: matches kept at most, mutual ones first; None keeps all.
    """
    clouds = []
    for points, features in (source, target):
        rows = np.sort(rng.permutation(len(points))[:keypoints])
        clouds.append(_cloud(points[rows], features[rows], voxel_size))
    matching = _MATCHING if kept is None else _MATCHING.model_copy(update={"max_correspondences": kept})
    found = match(clouds[0], clouds[1], matching, seed=0 if kept is None else int(rng.integers(1 << 31)))
    found = replace(found, normals=None, normals_signed=False)  # shards hold none
    residual = np.linalg.norm(transform_points(T_target_source, found.source) - found.target, axis=1)
    labels: BoolArray = residual < inlier_threshold * voxel_size
    return DrawnPair(found, labels, T_target_source, voxel_size, kept is not None)


_MATCHING = MatchingConfig(name="one_way", neighbors=1, max_correspondences=1_000_000)


def _cloud(points: Any, features: Any, voxel_size: float) -> PreparedCloud:
    """Keypoints as `match` takes them; their normals are not known and not used."""
    places = points.astype(np.float64)
    unit = features.astype(np.float32)
    return PreparedCloud(places, np.zeros_like(places), unit, voxel_size, np.zeros(3), np.zeros(3))
