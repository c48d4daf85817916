"""One process a GPU, as torchrun starts them: the rank of this process, agreement, and leaving together."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from contextlib import suppress
from typing import Any, NamedTuple

import torch

from legged_mw.utils.config import ConfigError

_PATIENCE = 20.0  # [s] far more than an iteration and a checkpoint take; torchrun kills after 30
_sockets: list[tuple[socket.socket, socket.socket]] = []  # referenced here, or they would close and silence the signals


class Rank(NamedTuple):
    """This process among those of the run."""

    index: int  # over all machines; 0 writes the run folder and speaks to the user
    local: int  # on this machine: the GPU it uses
    count: int

    @property
    def leads(self) -> bool:
        return self.index == 0


def this_rank() -> Rank:
    """The rank in torchrun's environment variables; without them, a single process."""
    index, local, count = (
        int(os.environ.get(*entry)) for entry in (("RANK", "0"), ("LOCAL_RANK", "0"), ("WORLD_SIZE", "1"))
    )
    return Rank(index, local, count) if count > 1 else Rank(0, 0, 1)


def rank_device(rank: Rank, device: str | None) -> str | None:
    """The device of this rank: its own GPU, or the CPU for ``--device cpu``. A single process keeps its ``device``."""
    if rank.count == 1 or device == "cpu":
        return device
    if device is not None:
        raise ConfigError(
            f"--device {device}: under torchrun every process takes the GPU of its own number; leave --device out"
        )
    if rank.local >= torch.cuda.device_count():
        seen = torch.cuda.device_count()
        advice = f"use --nproc_per_node={seen}" if seen else "say --device cpu to train on the CPU"
        raise ConfigError(f"torchrun started process {rank.local} on a machine with {seen} GPUs; {advice}")
    return f"cuda:{rank.local}"


def first_ranks(value: Any, device: str) -> Any:
    """The first rank's ``value``, on all ranks."""
    if this_rank().count == 1:
        return value
    torch.distributed.broadcast_object_list(agreed := [value], device=torch.device(device))
    return agreed[0]


def quiet(rank: Rank) -> None:
    """Silence all ranks but the first."""
    if not rank.leads:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 (open until the process ends)


def first_word(word: str) -> str:
    """The first word among all ranks that is not empty, with its rank; of a single process, its own."""
    if not torch.distributed.is_initialized():
        return word
    words: list[str] = [""] * torch.distributed.get_world_size()
    torch.distributed.all_gather_object(words, word)
    return next((f"rank {index}: {each}" for index, each in enumerate(words) if each), "")


def leave_together(rank: Rank, patience: float = _PATIENCE) -> None:
    """Close the connection once every rank is done. No recorded graph may use it any more.

    All files are written by now, so a connection that does not close in time ends with the process.
    """
    if rank.count == 1:
        return
    sys.stdout.flush()

    def leave() -> None:
        os.write(
            2,
            f"rank {rank.index}: the connection to the other ranks does not close; leaving, all is written\n".encode(),
        )
        os._exit(0)

    timer = threading.Timer(patience, leave)
    timer.daemon = True
    timer.start()
    with suppress(RuntimeError):  # another may have left already
        on_gpus = torch.distributed.get_backend() == "nccl"
        torch.distributed.barrier(device_ids=[rank.local] if on_gpus else None)
        torch.distributed.destroy_process_group()
    timer.cancel()


def leave_when_stuck(rank: Rank, patience: float = _PATIENCE) -> None:
    """After SIGTERM, end this process if it does not end by itself: it may wait for a dead rank.

    torchrun sends SIGTERM to the others when one dies. A process that waits for its GPU runs no signal handler in
    Python, but this thread does run. Call it from the main thread.
    """
    if rank.count == 1:
        return
    wake, listener = socket.socketpair()
    listener.setblocking(False)
    signal.set_wakeup_fd(listener.fileno(), warn_on_full_buffer=False)

    def watch() -> None:
        while signal.SIGTERM not in wake.recv(16):
            pass
        threading.Event().wait(patience)
        text = f"rank {rank.index}: still waiting for another rank {patience:g} s after SIGTERM; leaving."
        text += " The last checkpoint is whole.\n"
        os.write(2, text.encode())
        os._exit(128 + signal.SIGTERM)

    _sockets.append((wake, listener))
    threading.Thread(target=watch, daemon=True).start()
