"""Cost of handing CCDs to the workers of a Dask cluster, beside the CCDs' own: python benchmarks/cluster.py

Two workers of this machine do jobs that cost nothing, with what a CCD of the paper's size sends and returns, and CCDs
for real. What is left of a night is arithmetic, printed with the rest.
"""

import argparse
import pickle
import platform
import sys
import tempfile
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import distributed

from pachon import Configuration, Experiment, PachonError
from pachon.core.dask_cluster import dask_workers, local_cluster
from pachon.core.long_work import Job, JobComputation, JobResult
from pachon.pipeline.ccd_worker import compute_ccd
from pachon.pipeline.config import with_options

PARSER = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
PARSER.add_argument("jobs", type=int, nargs="?", default=400, help="empty jobs of each kind")
ARGUMENTS = PARSER.parse_args()
JOBS = ARGUMENTS.jobs
#: Size of the product of a CCD with 800 noise-free and 40 observed stars [byte].
PRODUCT = 3_900_000


@dataclass(frozen=True)
class Nothing:
    """A job's way there and back, without the work."""

    experiment: Experiment
    sent_back: int

    def __call__(self, job, threads):
        return JobResult(job.number, None, (("product", bytes(self.sent_back)),))


def seconds_a_job(client, compute, names):
    start = time.perf_counter()
    for result in dask_workers(compute, client).results(Job(i, name, name) for i, name in enumerate(names)):
        if isinstance(result.value, PachonError):
            sys.exit(str(result.value))
    return (time.perf_counter() - start) / len(names)


def main():
    experiment = Experiment.from_config(with_options(Configuration(), ccds=("all",), stars__truth=800))
    small = Experiment.from_config(with_options(Configuration(), ccds=("all",), stars__truth=21))
    names = experiment.config.ccds
    print(f"Python {platform.python_version()}, distributed {distributed.__version__}, two workers of one thread")
    with local_cluster(2, print) as client, tempfile.TemporaryDirectory() as folder:
        client.submit(len, ()).result()
        print(f"experiment sent with each job: {len(pickle.dumps(experiment)) / 1e3:.0f} kB")
        many = [f"{name}" for name in range(JOBS)]
        for title, size in (("product in a shared folder", 0), ("product sent back, 3.9 MB", PRODUCT)):
            seconds = seconds_a_job(client, Nothing(experiment, size), many)
            print(f"{title}: {1e3 * seconds:.1f} ms a job, {1.0 / seconds:.0f} jobs a second")
        for title, made in (("21 noise-free and 40 observed stars", small), ("800 and 40", experiment)):
            computation = JobComputation(partial(compute_ccd, made), Path(folder), "none")
            first = seconds_a_job(client, computation, names[:2])
            each = 2.0 * seconds_a_job(client, computation, names[2:8])
            print(f"CCD of {title}: {each:.1f} s of a worker; the first of each, with six screens: {2.0 * first:.0f} s")


if __name__ == "__main__":
    main()
