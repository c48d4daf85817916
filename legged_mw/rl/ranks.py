"""One process per GPU, started by torchrun: the rank of this process, exchange of values, and the common end."""

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

_PATIENCE = 20.0  # [s] much longer than an iteration with a checkpoint; torchrun kills after 30 s
_sockets: list[tuple[socket.socket, socket.socket]] = []  # references, so that they stay open for the signals


class Rank(NamedTuple):
    """The rank of this process."""

    index: int  # over all machines; 0 writes the run folder and prints
    local: int  # on this machine: the index of its GPU
    count: int  # number of processes

    @property
    def leads(self) -> bool:
        return self.index == 0


def this_rank() -> Rank:
    """The rank from torchrun's environment variables; without them a single process."""
    index, local, count = (
        int(os.environ.get(*entry)) for entry in (("RANK", "0"), ("LOCAL_RANK", "0"), ("WORLD_SIZE", "1"))
    )
    return Rank(index, local, count) if count > 1 else Rank(0, 0, 1)


def rank_device(rank: Rank, device: str | None) -> str | None:
    """The device of this rank: its own GPU, or the CPU for ``--device cpu``. A single process uses ``device``.

    Raises ConfigError for another ``device`` of several ranks, or a GPU that does not exist.
    """
    if rank.count == 1 or device == "cpu":
        return device
    if device is not None:
        raise ConfigError(
            f"--device {device}: under torchrun each process uses the GPU with its local rank; leave --device out"
        )
    if rank.local >= torch.cuda.device_count():
        seen = torch.cuda.device_count()
        advice = f"use --nproc_per_node={seen}" if seen else "say --device cpu to train on the CPU"
        raise ConfigError(f"torchrun started process {rank.local} on a machine with {seen} GPUs; {advice}")
    return f"cuda:{rank.local}"


def first_ranks(value: Any, device: str) -> Any:
    """Broadcast the first rank's ``value`` to all ranks."""
    if this_rank().count == 1:
        return value
    torch.distributed.broadcast_object_list(agreed := [value], device=torch.device(device))
    return agreed[0]


def quiet(rank: Rank) -> None:
    """Discard the output of all ranks but the first."""
    if not rank.leads:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 (open until the process ends)


def first_word(word: str) -> str:
    """The first text of all ranks that is not empty, with its rank; for a single process ``word``."""
    if not torch.distributed.is_initialized():
        return word
    words: list[str] = [""] * torch.distributed.get_world_size()
    torch.distributed.all_gather_object(words, word)
    return next((f"rank {index}: {each}" for index, each in enumerate(words) if each), "")


def leave_together(rank: Rank) -> None:
    """Close the connection when all ranks are done. No recorded graph may use it after that.

    All files are already written, so if the connection does not close within _PATIENCE the process ends.
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

    timer = threading.Timer(_PATIENCE, leave)
    timer.daemon = True
    timer.start()
    with suppress(RuntimeError):  # another rank may have ended
        on_gpus = torch.distributed.get_backend() == "nccl"
        torch.distributed.barrier(device_ids=[rank.local] if on_gpus else None)
        torch.distributed.destroy_process_group()
    timer.cancel()


def leave_when_stuck(rank: Rank, patience: float = _PATIENCE) -> None:
    """End this process if it still runs ``patience`` [s] after SIGTERM: it may wait for a rank that has died.

    If one rank dies, torchrun sends SIGTERM to the others. A process that waits for its GPU runs no signal handler in
    Python, but it runs this thread. Call it from the main thread.
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
