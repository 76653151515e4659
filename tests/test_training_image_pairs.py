"""Generated matches of two images: exact where they are true, drawn as the seed says, and learnt from."""

from __future__ import annotations

import pytest
import torch

from geomoe3d.geometry.essential import essential_of, label_threshold, symmetric_distance
from geomoe3d.networks.neighbors import neighbors_in_batch
from geomoe3d.training.batches import ImagePairs
from geomoe3d.training.config import load_train_config
from geomoe3d.training.image_pairs import ImagePairsConfig, generate_matches
from geomoe3d.training.losses import LossConfig, epipolar_loss
from geomoe3d.training.trainer import TrainingRun

pytestmark = pytest.mark.usefixtures("one_thread")

TINY = [
    "steps=30", "batch_size=4", "data.images.matches=200", "network.num_layers=2", "network.width=32",
    "network.num_heads=2", "network.num_sub_fields=12", "optimizer.learning_rate=5e-3", "device=cpu",
    "validation.num_pairs=4", "validation.every=30", "logging.tensorboard=false",
]  # fmt: skip


def configuration(*changes):
    return load_train_config("configs/train/images/geomoe.yaml", [*TINY, *changes])


def test_labels_are_those_of_the_true_pose_and_shares_fall_with_the_angle():
    drawn = generate_matches(ImagePairsConfig(matches=500, focal_length=(0.6, 0.9)), 64, 3)
    assert drawn.matches.shape == (64, 500, 4)
    assert bool(drawn.matches.isfinite().all())
    torch.testing.assert_close(drawn.truth[:, :3, 3].norm(dim=1), torch.ones(64))
    R = drawn.truth[:, :3, :3]
    torch.testing.assert_close(R @ R.transpose(1, 2), torch.eye(3).expand(64, 3, 3), atol=1e-5, rtol=0)
    far = symmetric_distance(essential_of(drawn.truth.double()), drawn.matches.double())
    assert torch.equal(far < label_threshold(1.0), drawn.labels)
    angle = torch.rad2deg(torch.arccos(((R.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1)))
    share = drawn.labels.float().mean(1)
    assert share[angle < 20].mean() > 1.5 * share[angle > 40].mean()
    assert angle.max() < 65.1


def test_labels_of_a_long_lens_are_as_strict_in_pixels():
    assert label_threshold(2.0).item() == label_threshold(1.0).item() == pytest.approx(1e-4)
    assert label_threshold(0.5).item() == pytest.approx(0.25e-4)
    drawn = generate_matches(ImagePairsConfig(matches=500, focal_length=(3.0, 3.0)), 32, 3)
    assert drawn.matches.abs().max() < 0.2
    assert 0.02 < drawn.labels.float().mean() < 0.6


def test_the_same_seed_draws_the_same_and_another_seed_others():
    config = ImagePairsConfig(matches=100)
    first, again, other = (generate_matches(config, 2, seed) for seed in (5, 5, 6))
    assert torch.equal(first.matches, again.matches)
    assert torch.equal(first.truth, again.truth)
    assert not torch.equal(first.matches, other.matches)


def test_neighbours_are_the_nearest_rows_the_row_itself_first():
    x = torch.randn(2, 40, 4, generator=torch.Generator().manual_seed(0))
    x[0, 1] = x[0, 0]  # a duplicate never takes the row's own place
    found = neighbors_in_batch(x, 5)
    assert torch.equal(found[..., 0], torch.arange(40).expand(2, 40))
    expected = torch.cdist(x, x).topk(5, largest=False).values
    gathered = torch.stack([(x[b][found[b]] - x[b][:, None]).norm(dim=-1) for b in range(2)])
    torch.testing.assert_close(gathered, expected, atol=1e-3, rtol=0)


def test_the_loss_is_zero_for_true_matches_alone_and_finite_for_degenerate_ones():
    drawn = generate_matches(ImagePairsConfig(matches=400, noise=(0, 0), any_share=1.0), 4, 1)
    exact = symmetric_distance(essential_of(drawn.truth.double()), drawn.matches.double()) < 1e-10
    for labels, matches in (
        (exact, drawn.matches),
        (exact & False, drawn.matches),
        (exact, drawn.matches * 0),
    ):
        logits = torch.where(labels, 5.0, -5.0)[None].requires_grad_()
        loss, unsolved = epipolar_loss(logits, matches, drawn.truth, LossConfig(virtual_points=4))
        loss.sum().backward()
        assert bool(logits.grad.isfinite().all())
        if labels is exact and matches is drawn.matches:
            assert loss.item() < 1e-6
            assert unsolved == 0
        else:
            assert unsolved == 4


def test_a_run_learns_and_goes_on_to_the_bit(tmp_path):
    class Silent:
        losses: list[float] = []  # noqa: RUF012

        def started(self, *_):
            pass

        validated = started

        def stepped(self, step, measures, *_):
            self.losses.append(measures["classification"])

    straight = TrainingRun(configuration(), tmp_path / "a")
    straight.train(Silent())
    losses = Silent.losses
    assert sum(losses[-5:]) < 0.93 * sum(losses[:5])
    for until in (13, None):
        broken = TrainingRun(configuration(), tmp_path / "b")
        broken.train(Silent(), until)
    for one, other in zip(straight.model.parameters(), broken.model.parameters(), strict=True):
        assert torch.equal(one, other)


def test_validation_pairs_are_the_same_for_every_training_seed():
    from geomoe3d.training.batches import validation_samples

    one, other = (validation_samples(configuration(f"seed={seed}")) for seed in (1, 2))
    assert torch.equal(one[3].inputs[0].coordinates, other[3].inputs[0].coordinates)
    batch = ImagePairs(configuration().data.images, configuration().network, 1).batch(4, 0)
    assert not torch.equal(batch.input.coordinates[3], one[3].inputs[0].coordinates)
