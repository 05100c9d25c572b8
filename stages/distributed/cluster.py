"""Ray: an executor on the workers of a cluster, or of this machine. No other module imports Ray.

Only paths and figures are sent: photographs and run folders lie where all workers see them. The
task of a lost worker is scheduled again and resumes from the stage's checkpoint in the run folder.
"""

from __future__ import annotations

import importlib
import os
import re
import socket
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event
from typing import Any

from stages.base.distribution import VERSION, install_command
from stages.base.errors import Family, Interrupted, ResourceError, SplatError, UsageError
from stages.base.memory import MIB
from stages.base.text import size
from stages.distributed.remote import Location, is_seen
from stages.distributed.tasks import (
    Executor,
    Resources,
    RunTask,
    SerialExecutor,
    TaskResult,
    run_task,
)
from stages.run.listener import Listener
from stages.run.stages import STAGE_NAMES, STAGE_OF

_LOCAL = re.compile(r"local:([1-9]\d{0,3})")
_ADDRESS = re.compile(r"(?:ray://)?([^/:\s]+):(\d{1,5})")
_DESCRIBE_TIMEOUT_S, _CONNECT_TIMEOUT_S = 120.0, 5.0
_POLL_S = 1.0  # how often a request to stop is looked for
_MAX_RETRIES = 20  # of one task whose worker was lost
_MIB = 1024 * 1024


def edition() -> str:
    """The version of the project and of its stages. Workers with another edition could write other
    bytes."""
    stages = ".".join(str(STAGE_OF[name].version) for name in STAGE_NAMES)
    return f"{VERSION} (stages {stages})"


@dataclass(frozen=True)
class Worker:
    """A worker's description of itself.

    unseen: the requested paths that it does not see. cpus, memory_mib: of its machine, for tasks.
    """

    host: str
    edition: str
    unseen: tuple[str, ...]
    cpus: int
    memory_mib: float


@dataclass(frozen=True)
class RayExecutor:
    """Executes tasks on workers that have been checked."""

    ray: Any
    workers: tuple[Worker, ...]

    def results(
        self, tasks: Sequence[RunTask], need: Resources, stop: Event | None = None
    ) -> Iterator[tuple[int, TaskResult]]:
        """See `tasks.Executor`. Raises SplatError "cluster-too-small"."""
        cpus, memory_mib = self.allocation(len(tasks), need)
        remote_run = self.ray.remote(_with_threads).options(
            num_cpus=cpus,
            num_gpus=need.gpus,
            memory=int(memory_mib * _MIB),
            max_retries=_MAX_RETRIES,
            retry_exceptions=[Interrupted],  # of a worker that is being shut down
        )
        waiting = {remote_run.remote(task, cpus): number for number, task in enumerate(tasks)}
        while waiting:
            ready, _ = self.ray.wait(list(waiting), num_returns=1, timeout=_POLL_S)
            if stop is not None and stop.is_set():
                raise Interrupted("the cluster's workers go on from their checkpoints")
            for reference in ready:
                yield waiting.pop(reference), self._result(reference)

    def allocation(self, tasks: int, need: Resources) -> tuple[int, float]:
        """(CPUs, MiB) for each of `tasks` tasks: the CPUs are divided among them, the memory is
        what one task needs. Raises SplatError "cluster-too-small", where Ray would wait forever."""
        least = min(worker.memory_mib for worker in self.workers)
        memory_mib = least if need.memory_mib is None else need.memory_mib
        largest = max(worker.memory_mib for worker in self.workers)
        if memory_mib > largest:
            raise ResourceError(
                "cluster-too-small",
                given=f"One task may take {size(memory_mib * MIB)}, and no worker has more than "
                f"{size(largest * MIB)}.",
                wanted="A worker with memory for the splats and photographs of one run.",
                hint="Ask for less: --max-splats, --train-side; or add a larger worker.",
            )
        every = sum(worker.cpus for worker in self.workers)
        fewest = min(worker.cpus for worker in self.workers)
        return max(1, min(fewest, every // tasks)), memory_mib

    def _result(self, reference: Any) -> TaskResult:
        try:
            result: TaskResult = self.ray.get(reference)
            return result
        except self.ray.exceptions.RayError as error:
            why = str(error).strip().splitlines()[0]
            return TaskResult(int(Family.RESOURCES), "worker-lost", f"Its worker was lost: {why}")


def _with_threads(task: RunTask, threads: int) -> TaskResult:
    os.environ["SPLAT_THREADS"] = str(threads)
    result = run_task(task)
    host = f" (On {socket.gethostname()}.)"  # for errors of that machine, such as a full disk
    return replace(result, message=result.message + host) if result.status else result


@contextmanager
def open_executor(
    address: str | None,
    folder: Location,
    paths: Iterable[Location],
    listener: Listener | None = None,
) -> Iterator[Executor]:
    """An executor for tasks in `folder`: the cluster at `address`, or without an address this
    process, which reports to the listener. Raises what `connect` raises."""
    if address is None:
        yield SerialExecutor(listener)
        return
    with connect(address, folder, paths) as executor:
        yield executor


@contextmanager
def connect(address: str, folder: Location, paths: Iterable[Location]) -> Iterator[RayExecutor]:
    """The cluster at `address` ("local:N": N workers of this machine, started and ended here).

    Each of its machines must have the same edition of the project, and see `folder` and all
    existing `paths`. folder: exists and can be written to; or a URL. Raises SplatError:
    cluster-not-installed, cluster-not-found, cluster-other-splat, cluster-folder-unseen.
    """
    ray = _ray()
    _start(ray, address)
    try:
        with _token(folder) as token:
            paths = list(paths)
            local = (p.absolute() for p in paths if isinstance(p, Path) and p.exists())
            urls = [path for path in (*paths, folder) if isinstance(path, str)]
            files = [path for path in (token, *local) if path is not None]
            workers = _describe_workers(ray, [*map(str, files), *urls])
            check(workers, edition(), token)
        yield RayExecutor(ray, tuple(workers))
    finally:
        ray.shutdown()


@contextmanager
def _token(folder: Location) -> Iterator[Path | None]:
    """A new file in the folder, which workers must see; None for a URL."""
    if isinstance(folder, str):
        yield None
        return
    with tempfile.NamedTemporaryFile(dir=folder, prefix=".seen-") as file:
        yield Path(file.name)


def check(workers: Sequence[Worker], ours: str, token: Path | None = None) -> None:
    """Check the workers. Raises SplatError (cluster-other-splat, cluster-folder-unseen) for those
    that cannot take tasks."""
    for worker in workers:
        if worker.edition != ours:
            raise UsageError(
                "cluster-other-splat",
                given=f"The worker {worker.host} has splat {worker.edition}; here it is splat "
                f"{ours}.",
                wanted="The same splat everywhere: another one makes other bytes.",
                hint=f"Install the same on all of them: {install_command('cluster')}",
            )
        if worker.unseen:
            new = token is not None and str(token) in worker.unseen
            folder = token.parent if token is not None and new else worker.unseen[0]
            raise UsageError(
                "cluster-folder-unseen",
                given=f"The worker {worker.host} does not see {folder}.",
                wanted="Photographs and run folders where all workers see them, at the same path.",
                hint="Put them on a folder that is shared, and name that; or at a URL that all of "
                "them can read.",
            )


def check_address(address: str) -> None:
    """Raises SplatError as `connect`, for what can be known without starting anything: whether Ray
    is installed, and whether something answers at the address."""
    _ray()
    _answers(address)


def _ray() -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # A cluster that was started with a token requires it; a client does not send it by default.
    token = Path.home() / ".ray" / "auth_token"
    if token.is_file() or os.environ.keys() & {"RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"}:
        os.environ.setdefault("RAY_AUTH_MODE", "token")
    try:
        return importlib.import_module("ray")
    except ImportError:
        raise UsageError(
            "cluster-not-installed",
            given="--cluster needs Ray, which is not installed.",
            wanted="The extra that brings it.",
            hint=f"{install_command('cluster')}; or leave --cluster away: the result is the same.",
        ) from None


def _start(ray: Any, address: str) -> None:
    quiet = {"log_to_driver": False, "logging_level": "ERROR", "include_dashboard": False}
    if local := _LOCAL.fullmatch(address):
        store = {"object_store_memory": 100 * _MIB}  # enough for paths and figures
        ray.init(address="local", num_cpus=int(local[1]), **store, **quiet)
        return
    _answers(address)
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except (OSError, RuntimeError, ValueError) as error:
        raise _not_found(address, str(error).strip().splitlines()[0]) from error


def _answers(address: str) -> None:
    """Raises SplatError "cluster-not-found" for no address, and for one where nothing answers."""
    if _LOCAL.fullmatch(address) or address == "auto":
        return
    host = _ADDRESS.fullmatch(address)
    if host is None:
        raise _not_found(address, "it is no address")
    try:
        socket.create_connection((host[1], int(host[2])), _CONNECT_TIMEOUT_S).close()
    except (OSError, OverflowError, ValueError) as error:
        raise _not_found(address, str(error).strip().splitlines()[0]) from error


def _not_found(address: str, why: str) -> SplatError:
    return UsageError(
        "cluster-not-found",
        given=f"No cluster answers at {address}: {why.rstrip('.')}.",
        wanted="The address of a Ray cluster (HOST:PORT, ray://HOST:PORT, auto), or local:N.",
        hint="Start one with `ray start --head`, or use --cluster local:4 for this machine.",
    )


def _describe_workers(ray: Any, paths: list[str]) -> list[Worker]:
    """Each machine of the cluster that takes tasks. Raises SplatError."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    nodes = [n for n in ray.nodes() if n["Alive"] and n["Resources"].get("CPU", 0) >= 1]
    describe = ray.remote(_describe)
    references = [
        describe.options(
            num_cpus=0,
            scheduling_strategy=NodeAffinitySchedulingStrategy(node["NodeID"], soft=False),
        ).remote(paths)
        for node in nodes
    ]
    if not nodes:
        raise _not_found("this address", "none of its machines takes tasks")
    try:
        described = ray.get(references, timeout=_DESCRIBE_TIMEOUT_S)
    except (ray.exceptions.RayError, TimeoutError) as error:
        raise _not_found("this address", str(error).strip().splitlines()[0]) from error
    return [
        Worker(
            f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})",
            *(found, tuple(unseen)),
            cpus=int(node["Resources"]["CPU"]),
            memory_mib=node["Resources"].get("memory", 0) / _MIB,
        )
        for node, (found, unseen) in zip(nodes, described, strict=True)
    ]


def _describe(paths: list[str]) -> tuple[str, list[str]]:
    """A worker's description of itself: (its edition, the paths that it does not see)."""
    return edition(), [path for path in paths if not is_seen(path)]
