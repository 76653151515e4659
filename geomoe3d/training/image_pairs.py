"""Matches of two images made up on the device that trains: cameras and surfaces drawn at random.

Nothing is rendered. Keypoints fall on an image in clusters; each belongs to one of a few surfaces, planes in
inverse depth with some roughness; a second camera looks at about the same place. Which share of the matches
is true, how exact they are, and where the wrong ones lead follows 2,000 RootSIFT keypoints matched to their
nearest neighbours in photographs (docs/images.md): the share falls from .42 at 6 degrees of rotation to .06
at 50, a third of the targets is hit more than once, and some wrong matches are near misses or whole groups
that agree on a shift, as windows of one facade do. Some milliseconds per batch, all of it in torch.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from pydantic import Field, model_validator
from torch import Tensor

from geomoe3d.config import Section
from geomoe3d.geometry.essential import (
    cross_matrix,
    essential_of,
    homogeneous,
    label_threshold,
    symmetric_distance,
)


class ImagePairsConfig(Section):
    """Difficulty of generated image matches."""

    matches: int = Field(2000, ge=16, description="per pair")
    rotation_deg: tuple[float, float] = Field((0.0, 65.0), description="angle between the cameras, evenly")
    focal_length: tuple[float, float] = Field(
        (0.5, 3.5), description="over the longer side of the image, drawn log-uniformly"
    )
    share_factor: float = Field(
        2.5, ge=1, description="share of true matches: the measured one, times or over at most this"
    )
    any_share: float = Field(0.15, ge=0, le=1, description="pairs whose share is 0.05 to 0.9 instead, evenly")
    share_at_deg: tuple[tuple[float, float], ...] = Field(
        ((0, 0.5), (6, 0.42), (14, 0.27), (26, 0.12), (40, 0.08), (55, 0.05), (180, 0.02)),
        description="median share of true matches by the angle of rotation, measured",
    )
    aspects: tuple[float, ...] = Field(
        (0.5625, 0.75, 1.0, 1.333, 1.5, 1.778, 3.3),
        description="width over height: upright and wide photographs, and a car's camera",
    )
    noise: tuple[float, float] = Field(
        (2e-4, 1.2e-3), description="standard deviation of a true match, in longer sides of the image"
    )
    repeated: float = Field(0.35, ge=0, le=1, description="pairs with groups that agree on wrong shifts")
    near_misses: float = Field(0.2, ge=0, le=1, description="largest share of wrong matches that end nearby")

    @model_validator(mode="after")
    def _check(self) -> ImagePairsConfig:
        for name in ("rotation_deg", "focal_length", "noise"):
            low, high = getattr(self, name)
            if not 0 <= low <= high:
                raise ValueError(f"{name} must be a range [low, high] with 0 <= low <= high")
        if self.focal_length[0] <= 0 or self.rotation_deg[1] > 90:
            raise ValueError("focal_length must be above 0, and rotation_deg at most 90")
        return self


class GeneratedMatches(NamedTuple):
    """B pairs of N matches.

    Attributes:
        matches: (B, N, 4) float32, rows [x0, y0, x1, y1], normalised by the intrinsics.
        labels: (B, N) bool, see `label_threshold`; chance hits included.
        truth: (B, 4, 4) float32 pose X1 = R X0 + t with |t| = 1.
    """

    matches: Tensor
    labels: Tensor
    truth: Tensor


def generate_matches(
    config: ImagePairsConfig, size: int, seed: int, device: torch.device | str = "cpu"
) -> GeneratedMatches:
    """Draw ``size`` pairs; the same seed gives the same pairs on the same kind of device."""
    draw = _Draw(size, config.matches, torch.Generator(device).manual_seed(seed), torch.device(device))
    half, half1 = _half_sizes(draw, config)
    first = draw.clustered(half)
    side = 2 * torch.minimum(half.amax(1), half1.amax(1))[:, None]
    surface, inverse_depth = _surfaces(draw, first, half)
    T, angle = _cameras(draw, config, inverse_depth, half1)
    points = homogeneous(first) / inverse_depth[..., None]
    moved = points @ T[:, :3, :3].transpose(1, 2) + T[:, None, :3, 3]
    exact = moved[..., :2] / moved[..., 2:].clamp(min=1e-3)
    seen = (moved[..., 2] > 0.05) & (exact.abs() < half1[:, None]).all(-1)
    true = _which_are_true(draw, config, angle, seen, surface)
    wrong = _wrong_targets(draw, config, first, exact, seen, half, half1)
    sigma = (draw.between(*config.noise, 1) * side)[..., None]
    sigma = sigma * torch.where(draw.uniform() < 0.1, 3.0, 1.0)[..., None]
    second = torch.where(true[..., None], exact, wrong)
    matches = torch.cat([first, second], dim=-1) + sigma * draw.normal(4)
    T[:, :3, 3] /= T[:, :3, 3].norm(dim=-1, keepdim=True).clamp(min=1e-9)
    labels = symmetric_distance(essential_of(T.double()), matches.double()) < label_threshold(side)
    return GeneratedMatches(matches, labels, T)


class _Draw:
    """Random numbers for B pairs of N matches; a last argument of 1 gives one number per pair, (B, 1)."""

    def __init__(self, size: int, num: int, generator: torch.Generator, device: torch.device) -> None:
        self.size, self.num, self.generator, self.device = size, num, generator, device

    def uniform(self, num: int | None = None) -> Tensor:
        shape = (self.size, self.num if num is None else num)
        return torch.rand(shape, generator=self.generator, device=self.device)

    def between(self, low: float, high: float, num: int | None = None) -> Tensor:
        return low + (high - low) * self.uniform(num)

    def normal(self, width: int, num: int | None = None) -> Tensor:
        shape = (self.size, self.num if num is None else num, width)
        return torch.randn(shape, generator=self.generator, device=self.device)

    def clustered(self, half: Tensor) -> Tensor:
        """Keypoints (B, N, 2) in images of half sizes (B, 2): some evenly, most around a few centres."""
        even = (torch.stack([self.uniform(), self.uniform()], -1) * 2 - 1) * half[:, None]
        clusters = 12
        centres = (torch.stack([self.uniform(clusters), self.uniform(clusters)], -1) * 2 - 1) * half[:, None]
        widths = torch.exp(self.between(-3.2, -1.0, clusters))[..., None] * half[:, None]
        chosen = (self.uniform().square() * clusters).long()[..., None].expand(-1, -1, 2)
        near = centres.gather(1, chosen) + widths.gather(1, chosen) * self.normal(2)
        inside = (near.abs() < half[:, None]).all(-1) & (self.uniform() > self.between(0.2, 0.9, 1))
        return torch.where(inside[..., None], near, even)


def _half_sizes(draw: _Draw, config: ImagePairsConfig) -> tuple[Tensor, Tensor]:
    """Half width and height of both images (B, 2) in focal lengths; seven pairs in ten share a camera."""
    low, high = torch.tensor(config.focal_length).log().tolist()
    aspects = torch.tensor(config.aspects, device=draw.device)
    sizes = []
    for _ in range(2):
        longer = 0.5 / torch.exp(draw.between(low, high, 1))
        aspect = aspects[(draw.uniform(1) * len(aspects)).long()]
        sizes.append(torch.cat([longer * aspect.clamp(max=1), longer / aspect.clamp(min=1)], dim=1))
    return sizes[0], torch.where(draw.uniform(1) < 0.7, sizes[0], sizes[1])


def _surfaces(draw: _Draw, first: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Of keypoints (B, N, 2) the surface (B, N) and the inverse depth; the middle of the scene lies near 1."""
    most = 8
    seeds = (torch.stack([draw.uniform(most), draw.uniform(most)], -1) * 2 - 1) * half[:, None]
    used = 1 + (draw.uniform(1) * most).long()
    unused = torch.arange(most, device=draw.device)[None] >= used
    surface = (torch.cdist(first, seeds) + 1e3 * unused[:, None].float()).argmin(-1)
    # What a long lens sees is as deep as it is wide, and that is little beside its distance.
    depth = (3 * half.amax(1, keepdim=True)).clamp(max=1)
    depth_spread = draw.between(0.05, 0.8, 1) * depth
    level = torch.exp(depth_spread * draw.normal(1, most)[..., 0])
    slope = draw.normal(2, most) * draw.between(0.0, 1.5, 1)[..., None]
    rows = surface[..., None].expand(-1, -1, 2)
    local = first - seeds.gather(1, rows)
    plane = level.gather(1, surface) * (1 + (slope.gather(1, rows) * local).sum(-1))
    # A tenth of the scenes is one plane without roughness, where no eight-point solve can succeed.
    rough = torch.exp(draw.between(-5.0, -1.2, 1)) * (draw.uniform(1) > 0.1) * depth
    return surface, (plane * torch.exp(rough * draw.normal(1)[..., 0])).clamp(0.05, 5.0)


def _cameras(
    draw: _Draw, config: ImagePairsConfig, inverse_depth: Tensor, half1: Tensor
) -> tuple[Tensor, Tensor]:
    """Poses (B, 4, 4) whose second camera looks at about the same place, and angles (B,) in degrees."""
    angle = draw.between(*config.rotation_deg, 1)
    # Mostly about axes across the line of sight: around an object, or a head that turns.
    axis = draw.normal(3, 1)[:, 0] * angle.new_tensor([1.0, 1.5, 0.35])
    upright = (draw.uniform(1) < 0.5).float()
    axis = axis * (1 - upright * angle.new_tensor([0.8, 0.0, 0.8]))
    axis = axis / axis.norm(dim=1, keepdim=True).clamp(min=1e-6)
    K, radians = cross_matrix(axis), torch.deg2rad(angle)[..., None]
    R = torch.eye(3, device=draw.device) + radians.sin() * K + (1 - radians.cos()) * K @ K
    middle = 1 / inverse_depth.median(dim=1, keepdim=True).values
    centre = torch.cat([torch.zeros_like(middle), torch.zeros_like(middle), middle], dim=1)
    place = (torch.cat([draw.uniform(1), draw.uniform(1)], 1) * 2 - 1) * half1 * 0.6
    forward = draw.uniform(1) < 0.25
    nearer = torch.where(forward, draw.between(0.4, 0.9, 1), torch.exp(0.2 * draw.normal(1, 1)[..., 0]))
    place = torch.where(forward, place * 0.3, place)
    goal = homogeneous(place) * middle * nearer
    t = goal - (R @ centre[..., None])[..., 0]
    # A camera cannot stand closer than this to where it stood: rotation alone has no translation to learn.
    least = 0.02 * middle
    short = t.norm(dim=1, keepdim=True)
    t = torch.where(short < least, t + least * torch.sign(t + 1e-9), t)
    T = torch.eye(4, device=draw.device).repeat(draw.size, 1, 1)
    T[:, :3, :3], T[:, :3, 3] = R, t
    return T, angle[:, 0]


def _which_are_true(
    draw: _Draw, config: ImagePairsConfig, angle: Tensor, seen: Tensor, surface: Tensor
) -> Tensor:
    """(B, N) bool: of the points that both images see as many as SIFT would match, some surfaces better."""
    knots = angle.new_tensor(config.share_at_deg)
    place = torch.searchsorted(knots[:, 0].contiguous(), angle.contiguous()).clamp(1, len(knots) - 1)
    low, high = knots[place - 1], knots[place]
    along = (angle - low[:, 0]) / (high[:, 0] - low[:, 0])
    median = low[:, 1] + along * (high[:, 1] - low[:, 1])
    factor = torch.exp(draw.between(-1, 1, 1) * torch.tensor(config.share_factor).log().item())[:, 0]
    free = draw.uniform(1)[:, 0] < config.any_share
    share = torch.where(free, draw.between(0.05, 0.9, 1)[:, 0], (median * factor).clamp(0.01, 0.9))
    ease = torch.exp(1.2 * draw.normal(1, 8)[..., 0]).gather(1, surface)
    key = draw.uniform().clamp(min=1e-9).log() / ease
    key = torch.where(seen, key, -torch.inf)
    rank = key.argsort(dim=1, descending=True).argsort(dim=1)
    return seen & (rank < (share * draw.num)[:, None])


def _wrong_targets(
    draw: _Draw,
    config: ImagePairsConfig,
    first: Tensor,
    exact: Tensor,
    seen: Tensor,
    half: Tensor,
    half1: Tensor,
) -> Tensor:
    """Where wrong matches lead (B, N, 2): keypoints of image 1, some of them often; nearby; or a group's shift."""
    # Keypoints of image 1: what of the scene it sees, and what image 0 does not see.
    keypoints = torch.where((seen & (draw.uniform() < 0.7))[..., None], exact, draw.clustered(half1))
    order = draw.uniform().argsort(dim=1)
    keypoints = keypoints.gather(1, order[..., None].expand(-1, -1, 2))
    hubs = (draw.uniform() ** 1.4 * draw.num).long()
    wrong = keypoints.gather(1, hubs[..., None].expand(-1, -1, 2))
    near = seen & (draw.uniform() < draw.between(0, config.near_misses, 1))
    reach = torch.exp(draw.between(-4.0, -1.5, 1))[..., None] * half1[:, None]
    wrong = torch.where(near[..., None], exact + reach * draw.normal(2), wrong)
    # Repeated structure: pieces of the image matched to a copy, one or two steps of a lattice away.
    groups = 4
    centres = (torch.stack([draw.uniform(groups), draw.uniform(groups)], -1) * 2 - 1) * half[:, None]
    radii = draw.between(0.1, 0.5, groups) * half.amin(1, keepdim=True)
    distance = torch.cdist(first, centres) / radii[:, None]
    least, group = distance.min(dim=-1)
    step = draw.normal(2, 1) * 0.35 * half1[:, None]
    steps = torch.tensor([-2.0, -1.0, 1.0, 2.0], device=draw.device)
    times = steps[(draw.uniform(groups) * len(steps)).long()].gather(1, group)
    copied = exact + times[..., None] * step
    inside = (copied.abs() < half1[:, None]).all(-1) & seen & (least < 1)
    use = inside & (draw.uniform(1) < config.repeated) & (draw.uniform() < draw.between(0.1, 0.7, 1))
    return torch.where(use[..., None], copied, wrong)
