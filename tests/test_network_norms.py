"""Norms of the network: masked ones see the real entries alone, recomputed ones equal the plain chain."""

from __future__ import annotations

import pytest
import torch

from geomoe3d.networks.norms import BatchNorm, ContextNorm, Pointwise, frozen_statistics, norm_relu_linear

pytestmark = pytest.mark.usefixtures("one_thread")


def test_masked_norms_equal_the_norms_of_the_real_entries_and_their_gradients() -> None:
    x = torch.randn(
        3, 4, 9, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True
    )
    mask = torch.arange(9)[None, None] < torch.tensor([9, 4, 2])[:, None, None]
    norm, plain = BatchNorm(4).double(), torch.nn.BatchNorm1d(4).double()
    for module in (norm, plain):
        with torch.no_grad():
            module.weight.copy_(torch.tensor([1.0, 2, 3, 4]))
            module.bias.copy_(torch.tensor([0.5, 0, -1, 2]))
    real = x.transpose(1, 2)[mask[:, 0]]
    torch.testing.assert_close(norm(x, mask).transpose(1, 2)[mask[:, 0]], plain(real))
    torch.testing.assert_close(norm.running_mean, plain.running_mean)
    torch.testing.assert_close(norm.running_var, plain.running_var)
    context = ContextNorm()
    for i, n in enumerate((9, 4, 2)):
        torch.testing.assert_close(context(x, mask)[i, :, :n], context(x[i : i + 1, :, :n])[0])

    def real_part(x: torch.Tensor) -> torch.Tensor:
        return torch.cat([torch.masked_select(f(x, mask), mask) for f in (norm, context)])

    assert torch.autograd.gradcheck(real_part, (x,))


@pytest.mark.parametrize("shape", [(3, 4, 7), (1, 4, 5)])
def test_recomputed_norm_relu_linear_equals_the_plain_chain(shape: tuple[int, int, int]) -> None:
    torch.manual_seed(0)
    norm, linear = BatchNorm(4).double().train(), Pointwise(4, 3).double()
    with torch.no_grad():
        norm.weight.copy_(torch.tensor([0.5, -1, 2, 1]))
        norm.bias.copy_(torch.tensor([0.1, 0.2, -0.3, 0]))
    x = torch.randn(shape, dtype=torch.float64, requires_grad=True)
    inputs = (x, norm.weight, norm.bias, linear.weight, linear.bias)
    plain = torch.nn.BatchNorm1d(4).double()
    plain.load_state_dict(norm.state_dict())
    expected = torch.nn.functional.conv1d(torch.relu(plain(x)), linear.weight, linear.bias)
    got = norm_relu_linear(x, norm, linear)
    torch.testing.assert_close(got, expected)
    torch.testing.assert_close(norm.running_mean, plain.running_mean)
    torch.testing.assert_close(norm.running_var, plain.running_var)
    assert norm.num_batches_tracked == 1
    before = norm.running_mean.clone()
    with frozen_statistics():
        torch.testing.assert_close(norm_relu_linear(x, norm, linear), expected)
        norm(x)
    assert torch.equal(norm.running_mean, before)
    assert torch.autograd.gradcheck(lambda *_: norm_relu_linear(x, norm, linear), inputs)
