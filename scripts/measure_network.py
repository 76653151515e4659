"""Time and memory of the GeoMoE network on this machine, as a table.

    python scripts/measure_network.py              everything, a few minutes
    python scripts/measure_network.py --quick      N = 250, 1000 and 5000, fewer repetitions

Times are medians; the limit is the network's multiply-accumulates (attention products counted) over the
rate of a 2048-square float32 product timed in turn with it, so a busy machine slows both alike. With
--cpu-time one thread's CPU time is taken instead of the clock: what to read where other jobs run.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.counting import count_cost, num_parameters
from geomoe3d.networks.folded import FoldedGeoMoE
from geomoe3d.networks.geomoe import GeoMoE, find_neighbors
from geomoe3d.networks.inputs import pair_input

SIZES = (250, 500, 1000, 2000, 5000, 10_000, 20_000)
SQUARE = 2048
STRONGER = {"extra_channels": ("compatibility", "hypothesis"), "knn_space": "compatibility"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--cpu-time", action="store_true")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--only", choices=("inference", "training", "memory"))
    parser.add_argument("--child", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.cpu_time:
        torch.set_num_threads(1)
    elif options.threads:
        torch.set_num_threads(options.threads)
    if options.child:
        print(json.dumps(child(options.child)))
        return
    clock = time.thread_time if options.cpu_time else time.perf_counter
    kind = "CPU time of one thread" if options.cpu_time else f"{torch.get_num_threads()} threads"
    print(f"torch {torch.__version__}, {kind}, load average {os.getloadavg()[0]:.1f}")
    if options.only in (None, "inference"):
        inference((250, 1000, 5000) if options.quick else SIZES, 5 if options.quick else 11, clock)
    if options.only in (None, "training"):
        training(3 if options.quick else 6, clock)
    if options.only in (None, "memory"):
        memory((1000, 5000, 20_000))


def network() -> GeoMoE:
    torch.manual_seed(0)
    model = GeoMoE().train()
    model(torch.randn(2, 300, 6))
    return model.eval()


def inference(sizes: tuple[int, ...], repeats: int, clock: Callable[[], float]) -> None:
    model = network()
    folded = FoldedGeoMoE.of(model)
    square = torch.randn(SQUARE, SQUARE)
    stronger = NetworkConfig(**STRONGER)
    print(f"\ninference, batch 1, {num_parameters(model):,} parameters, milliseconds")
    print(f"{'N':>6} {'GMAC':>6} {'limit':>7} {'plain':>7} {'folded':>7} {'x limit':>8} {'with knn':>9} "
          f"{'knn':>6} {'invariant inputs':>17} {'max |diff|':>11}")  # fmt: skip
    for num in sizes:
        cost = count_cost(model, num).products
        x = torch.randn(1, num, 6)
        neighbors = find_neighbors(x, model.config)
        points = (torch.rand(num, 6) * 3).numpy()
        with torch.no_grad():
            plain_logits = model(x, None, neighbors).logits[:, 0]
        rows, near = x[0].numpy(), neighbors[0].numpy()
        difference = float(np.abs(folded(rows, None, near).logits - plain_logits.numpy()).max())

        def plain(x: torch.Tensor = x, neighbors: torch.Tensor = neighbors) -> None:
            with torch.no_grad():
                model(x, None, neighbors)

        jobs: dict[str, Callable[[], object]] = {
            "square": lambda: square @ square,
            "plain": plain,
            "folded": lambda x=rows, n=near: folded(x, None, n),  # type: ignore[misc]
            "knn": lambda x=x: find_neighbors(x, model.config),  # type: ignore[misc]
            "inputs": lambda p=points: pair_input(p, 0.05, stronger),  # type: ignore[misc]
        }
        times: dict[str, list[float]] = {name: [] for name in jobs}
        for _ in range(repeats if num <= 5000 else max(3, repeats // 3)):
            for name, job in jobs.items():
                begin = clock()
                job()
                times[name].append((clock() - begin) * 1e3)
        ms = {name: statistics.median(values) for name, values in times.items()}
        limit = ms["square"] * cost / SQUARE**3
        print(f"{num:>6} {cost / 1e9:>6.2f} {limit:>7.1f} {ms['plain']:>7.1f} {ms['folded']:>7.1f} "
              f"{ms['folded'] / limit:>8.2f} {(ms['folded'] + ms['knn']) / limit:>9.2f} {ms['knn']:>6.1f} "
              f"{ms['inputs']:>17.1f} {difference:>11.1e}")  # fmt: skip


def training(repeats: int, clock: Callable[[], float]) -> None:
    from torch.profiler import ProfilerActivity, profile

    step, size = training_step(8, 1000)
    step()
    times = []
    for _ in range(repeats):
        begin = clock()
        step()
        times.append(clock() - begin)
    with profile(activities=[ProfilerActivity.CPU]) as profiler:  # it slows what it watches: timed before
        step()
    products = ("mm", "bmm", "addmm", "baddbmm", "convolution", "conv2d", "conv1d", "mkldnn_convolution")
    events = profiler.key_averages()
    total = sum(e.self_cpu_time_total for e in events)
    inside = sum(e.self_cpu_time_total for e in events if any(p in e.key for p in products))
    middle = statistics.median(times)
    print(f"\ntraining step of 8 x 1000: {middle:.2f} s, {size / middle:.1f} pairs/s, "
          f"{100 * (1 - inside / total):.0f} % of the time outside matrix products")  # fmt: skip


def training_step(size: int, num: int) -> tuple[Callable[[], None], int]:
    """One full step (forward, losses, backward, update) of the faithful configuration on made-up pairs."""
    from geomoe3d.training.batches import first_batch
    from geomoe3d.training.config import TrainConfig
    from geomoe3d.training.step import Updater
    from geomoe3d.training.synthetic import SyntheticConfig

    config = TrainConfig(batch_size=size)
    data = config.data.model_copy(
        update={"correspondences": num, "synthetic": SyntheticConfig(correspondences=(num, num))}
    )
    config = config.model_copy(update={"data": data})
    batch = first_batch(config)
    model = GeoMoE().train()
    updater = Updater(model, model, torch.optim.AdamW(model.parameters(), lr=1e-4, fused=True), config)

    def step() -> None:
        updater.step(iter([batch]), 1.0, 1e-4, torch.device("cpu"))

    return step, size


def memory(sizes: tuple[int, ...]) -> None:
    print("\npeak memory of a process of its own, MiB above what it holds before")
    for num in sizes:
        print(f"  inference N = {num}: {run_child(f'inference:{num}'):.0f}")
    print(f"  inputs of the stronger form N = {sizes[-1]}: {run_child(f'inputs:{sizes[-1]}'):.0f}")
    print(f"  training step 8 x 1000: {run_child('training:8:1000'):.0f}")
    print(f"  training step 32 x 2000: {run_child('training:32:2000'):.0f}")


def run_child(job: str) -> float:
    command = [sys.executable, __file__, "--child", job, "--threads", str(torch.get_num_threads())]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(json.loads(done.stdout))


def child(job: str) -> float:
    kind, *numbers = job.split(":")
    if kind == "training":
        training_step(2, 50)[0]()  # imports and thread pools are not the step's
        step, _ = training_step(int(numbers[0]), int(numbers[1]))
    elif kind == "inputs":
        pair_input((torch.rand(50, 6) * 3).numpy(), 0.05, NetworkConfig(**STRONGER))
        points = (torch.rand(int(numbers[0]), 6) * 3).numpy()

        def step() -> None:
            pair_input(points, 0.05, NetworkConfig(**STRONGER))
    else:
        folded = FoldedGeoMoE.of(network())
        x = torch.randn(1, int(numbers[0]), 6)

        def step() -> None:
            folded(x[0].numpy(), None, find_neighbors(x, folded.config)[0].numpy())

    before = peak_mib()
    step()
    return peak_mib() - before


def peak_mib() -> float:
    """Largest memory this process has held. Not ru_maxrss: a child starts with its parent's."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024
    raise SystemExit("peak memory is read from /proc, which this system does not have")


if __name__ == "__main__":
    main()
