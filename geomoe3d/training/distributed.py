"""One process or many: who am I, and what must be shared. ``torchrun`` sets the environment."""

from __future__ import annotations

import gc
import os
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist

from geomoe3d.errors import ConfigError


@dataclass(frozen=True)
class Process:
    """This process among all that train together."""

    rank: int = 0
    world: int = 1
    local_rank: int = 0

    @property
    def is_first(self) -> bool:
        """True for the one that logs, validates and writes."""
        return self.rank == 0

    def wait(self) -> None:
        """Until every process is here."""
        if self.world > 1:
            dist.barrier()


def join() -> Process:
    """Join the group that ``torchrun`` describes (nccl with GPUs, else gloo), or stay alone."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world == 1:
        return Process()
    if not dist.is_initialized():
        backend = "nccl" if torch.cuda.is_available() else "gloo"
        dist.init_process_group(backend, timeout=timedelta(minutes=60))
    return Process(dist.get_rank(), dist.get_world_size(), int(os.environ.get("LOCAL_RANK", "0")))


def leave() -> None:
    """Leave the group, if in one; let go before of what holds it, such as a model that shares gradients."""
    if dist.is_available() and dist.is_initialized():
        gc.collect()  # held in a cycle the group's threads would outlive it, and abort the process as it ends
        dist.destroy_process_group()


def choose_device(name: str, process: Process) -> torch.device:
    """``auto``: this process's GPU if there is one, else the CPU; ``cuda`` alone: this process's GPU. Raises
    ConfigError: no device of this name, or none on this machine."""
    there = torch.cuda.is_available()
    if name == "auto":
        name = "cuda" if there else "cpu"
    if name == "cuda":
        name = f"cuda:{process.local_rank}"
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ConfigError(f"device is '{name}'; choose auto, cpu, cuda or cuda:0") from None
    if device.type not in ("cpu", "cuda"):
        raise ConfigError(f"device is '{name}'; training runs on cpu or cuda")
    if device.type == "cuda":
        if not there:
            raise ConfigError(f"device is '{name}', but PyTorch finds no GPU here; choose cpu or auto")
        torch.cuda.set_device(device)
    return device
