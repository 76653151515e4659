"""One batch is learnt by heart, in either form of the network."""

from __future__ import annotations

import pytest
from training_runs import TREE, config_of

from geomoe3d.training.overfit import overfit_one_batch

pytestmark = pytest.mark.usefixtures("one_thread")


def test_one_batch_is_learnt_by_heart() -> None:
    config = config_of(
        batch_size=3,
        network={**TREE["network"], "width": 32, "extra_channels": ["compatibility"],  # type: ignore[dict-item]
                 "knn_space": "compatibility"},
    )  # fmt: skip
    steps, f1 = overfit_one_batch(config, 300)
    assert f1 > 0.99
    assert steps < 300


@pytest.mark.slow
def test_faithful_form_learns_one_batch_by_heart() -> None:
    network = {**TREE["network"], "width": 64, "num_sub_fields": 12}  # type: ignore[dict-item]
    _, f1 = overfit_one_batch(config_of(batch_size=2, network=network), 400)
    assert f1 > 0.99
