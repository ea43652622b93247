"""Results in the order of the jobs, whatever the order in which workers end them."""

import pytest

from pachon.core.errors import DomainError
from pachon.core.ordered_jobs import ordered_results
from pachon.core.progress import Reporter
from pachon.core.workers import Workers


def square(content, threads):
    if content < 0:
        raise DomainError("expected at least 0", key="content")
    return content**2


def shuffled(compute):
    """Workers that end jobs in pairs, the later one first."""

    def results(jobs):
        jobs = list(jobs)
        for i in range(0, len(jobs), 2):
            for job in reversed(jobs[i : i + 2]):
                yield compute(job, 1)

    return Workers("shuffled", 3, results)


def ordered(contents, **options):
    labels = [f"job {content}" for content in contents]
    return ordered_results(square, labels, contents, reporter=Reporter(quiet=True), **options)


@pytest.mark.parametrize("title", [None, "squares"])
@pytest.mark.parametrize("workers", [None, shuffled])
def test_results_keep_the_order_of_the_jobs(workers, title):
    assert list(ordered([3, 1, 4, 1.5, 9], workers=workers, title=title)) == [9, 1, 16, 2.25, 81]
    assert list(ordered([], workers=workers, title=title)) == []


def test_a_result_is_there_before_the_jobs_after_it_are_computed():
    taken = []

    def contents():
        for content in (1, 2, 3):
            taken.append(content)
            yield content

    results = ordered_results(square, ["a", "b", "c"], contents(), reporter=Reporter(quiet=True))
    assert next(results) == 1
    assert taken == [1]


@pytest.mark.parametrize("workers", [None, shuffled])
def test_an_error_names_the_job_and_keeps_its_class(workers):
    with pytest.raises(DomainError, match=r"^job -2: expected at least 0$") as caught:
        list(ordered([1, -2, 3], workers=workers))
    assert caught.value.key == "content"


def test_memory_is_checked_before_the_first_job():
    def check(processes):
        raise DomainError(f"{processes} processes are too many")

    with pytest.raises(DomainError, match=r"^3 processes are too many"):
        next(ordered([-1], workers=shuffled, check=check))
