"""Reductions of the CCDs that are exposed together."""

from pachon.core.errors import DomainError, ProductError
from pachon.pipeline.simulate.ccd_loop import one_by_one


def test_a_ccd_that_fails_stops_no_other_and_a_product_that_cannot_be_written_does():
    done = []

    def reduce(name, problem):
        done.append(name)
        if problem is not None:
            raise problem
        return name.lower()

    unmodelled, unwritten = DomainError("3 stars: expected at least 6"), ProductError("the disk is full")
    assert one_by_one(reduce, "ABC", (None, unmodelled, None)) == ["a", unmodelled, "c"]
    assert one_by_one(reduce, "DEF", (None, unwritten, None)) == ["d", unwritten]
    assert done == ["A", "B", "C", "D", "E"]
