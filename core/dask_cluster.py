"""Workers of a Dask cluster, on any number of machines; the package ``distributed`` must be installed."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from itertools import islice
from typing import Any
from uuid import uuid4

from .errors import ConfigError, ProductError
from .version import VERSION
from .workers import JOBS_AHEAD, Compute, Workers

#: Timeout of the connection to a scheduler [s].
CONNECT_SECONDS = 20.0


def dask_workers(compute: Compute, client: Any, *, local: bool = False) -> Workers:
    """Return the workers of a Dask cluster, reached through a ``distributed.Client``; `local` ones are of this machine.

    Jobs of a lost worker are repeated by another one. Without workers, results wait for the first one.
    """
    info = client.scheduler_info()
    count = len(info["workers"])
    description = f"{count} Dask worker{'s' * (count != 1)} of {info['address']}"

    def results(jobs: Iterable[Any]) -> Generator[Any, None, None]:
        from distributed import CancelledError, as_completed
        from distributed.scheduler import KilledWorker

        source = iter(jobs)
        ahead = JOBS_AHEAD * max(1, sum(client.nthreads().values()))
        # Own keys: one scheduler may serve several computations, each with a first job.
        batch = uuid4().hex[:8]

        def submit(job: Any) -> Any:
            # On one thread: Dask runs as many jobs side by side as a worker has threads.
            return client.submit(compute, job, 1, key=f"pachon-{batch}-{job.label}")

        running = as_completed([submit(job) for job in islice(source, ahead)], loop=client.loop, raise_errors=False)
        for future in running:
            try:
                yield future.result()
            except KilledWorker:
                raise ProductError(
                    f"{future.key.split('-', 2)[2]}: the workers that computed it died, one after another; "
                    "are they short of memory? What was computed is kept, go on with --resume"
                ) from None
            except (CancelledError, OSError):
                raise ProductError(
                    "the Dask scheduler is lost; what was computed is kept, go on with --resume"
                ) from None
            following = next(source, None)
            if following is not None:
                running.add(submit(following))

    return Workers(description, count if local else 0, results)


@contextmanager
def dask_client(address: str, security: Any = None) -> Iterator[Any]:
    """Connect to a Dask scheduler, such as ``tls://host:8786``, whose workers have the same pachon.

    `security` is a ``distributed.Security``, by default that of Dask's own configuration. No answer, another version of
    pachon, or no package ``distributed`` are a ConfigError.
    """
    _require_distributed("--scheduler")
    if not re.fullmatch(r"(tcp|tls|ws|wss|ucx)://\S+:\d+", address):
        raise ConfigError(f"--scheduler = {address}: expected an address such as tcp://host:8786 or tls://host:8786")
    from distributed import Client, Security

    security = Security() if security is None else security
    _require_certificates(address, security)
    with _quiet_dask():
        try:
            client = Client(address, timeout=CONNECT_SECONDS, security=security, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise ConfigError(
                f"--scheduler = {address}: no answer within {CONNECT_SECONDS:g} s ({_first_line(error)}); is the "
                "scheduler running, the address as it prints it, the port open, TLS the same on both sides?"
            ) from None
        try:
            check_versions(client)
            yield client
        finally:
            client.close(timeout=5)


@contextmanager
def local_cluster(workers: int | None, say: Callable[[str], None]) -> Iterator[Any]:
    """Start a Dask cluster of processes on this machine, print the address of its dashboard, and connect to it."""
    _require_distributed("--workers")
    from distributed import Client, LocalCluster

    with (
        _quiet_dask(),
        LocalCluster(n_workers=workers, threads_per_worker=1, processes=True) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        say(f"Dask dashboard: {cluster.dashboard_link}")
        yield client


def check_versions(client: Any) -> None:
    """Refuse workers with another version of pachon, whose results may differ, or without it."""
    for worker, theirs in client.run(_version, on_error="return").items():
        if not isinstance(theirs, str):
            raise ConfigError(f"worker {worker}: pachon cannot be imported there ({_first_line(theirs)})")
        if theirs != VERSION:
            raise ConfigError(f"worker {worker}: has pachon {theirs}, expected {VERSION} as here")


@contextmanager
def _quiet_dask() -> Iterator[None]:
    """Silence Dask's tracebacks of lost connections: an error of one line replaces them."""
    import distributed  # noqa: F401 - sets up its loggers

    names = [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed"]
    before = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)


def _require_certificates(address: str, security: Any) -> None:
    """Refuse an address that the certificates of this side do not fit, which Dask finds out late and in many lines."""
    try:
        arguments = security.get_connection_args("client")
    except (OSError, ValueError, TypeError) as error:
        raise ConfigError(
            f"--scheduler = {address}: the certificates of distributed.comm.tls cannot be used ({_first_line(error)})"
        ) from None
    encrypted = address.startswith(("tls", "wss"))
    if encrypted and arguments.get("ssl_context") is None:
        raise ConfigError(
            f"--scheduler = {address}: expected distributed.comm.tls in Dask's configuration: ca-file, and cert and "
            "key of the client"
        )
    if not encrypted and arguments.get("require_encryption"):
        raise ConfigError(
            f"--scheduler = {address}: Dask's configuration requires encryption; expected an address with tls://"
        )


def _require_distributed(option: str) -> None:
    if find_spec("distributed") is None:
        raise ConfigError(f"{option} needs the package distributed: pip install 'pachon[dask]'")


def _version() -> str:
    return VERSION


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
