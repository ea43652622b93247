"""Errors carry file, place, key and subject as fields, and keep them when they are raised again in a wider context."""

import pickle

import pytest

from pachon.core.errors import (
    ConfigError,
    DomainError,
    PachonError,
    PrescriptionError,
    ProductError,
    UnknownNameError,
    error_context,
)


def test_the_text_has_subject_file_place_and_problem():
    error = ConfigError("a = 1: expected 2", subject="CCD R22", file="run.yaml", place="line 3", key="a")
    assert str(error) == "CCD R22: run.yaml, line 3: a = 1: expected 2"
    assert error.reason == "run.yaml, line 3: a = 1: expected 2"
    assert str(PachonError("alone")) == "alone"


def test_a_section_goes_in_front_of_the_key():
    error = PrescriptionError("radius = 0: expected more", key="radius").within(file="tel.yaml", key="surfaces[M1]")
    assert str(error) == "tel.yaml: surfaces[M1].radius = 0: expected more"
    assert (type(error), error.file, error.key) == (PrescriptionError, "tel.yaml", "surfaces[M1].radius")
    assert error.within(file="tel.yaml", key="surfaces") is error


def test_an_error_of_another_file_is_told_by_the_key_that_names_it():
    error = PrescriptionError("no such file", file="grid.fits").within(file="tel.yaml", key="surfaces[M1]")
    assert str(error) == "tel.yaml: surfaces[M1]: grid.fits: no such file"
    assert (error.file, error.key) == ("tel.yaml", "surfaces[M1]")


def test_a_subject_stands_first_and_can_be_left_out():
    error = ConfigError("no light", file="run.yaml").within(subject="CCD R22")
    assert str(error) == "CCD R22: run.yaml: no light"
    assert error.reason == "run.yaml: no light"
    assert str(error.within(file="sweep.yaml")) == "sweep.yaml: CCD R22: run.yaml: no light"


def test_a_block_raises_in_its_context():
    with (
        pytest.raises(ConfigError, match=r"^a\.yaml, surface 2: k = 1$"),
        error_context(file="a.yaml", place="surface 2"),
    ):
        raise ConfigError("k = 1")


def test_a_key_can_have_the_name_of_an_option():
    error = ConfigError("n_pupil = 4: expected more than 8", key="n_pupil").renamed("--rays")
    assert (str(error), error.key) == ("--rays = 4: expected more than 8", "--rays")


def test_fields_survive_a_process():
    error = pickle.loads(pickle.dumps(ConfigError("k = 1", file="a.yaml", key="k")))
    assert (str(error), error.file, error.key) == ("a.yaml: k = 1", "a.yaml", "k")


def test_errors_of_values_and_names_are_the_built_in_ones_too():
    for kind in (ConfigError, PrescriptionError, DomainError):
        assert issubclass(kind, PachonError)
        assert issubclass(kind, ValueError)
    assert issubclass(UnknownNameError, KeyError)
    assert not issubclass(ProductError, (ValueError, KeyError))
    # A KeyError's own text would stand in quotes.
    assert str(UnknownNameError("unknown CCD 'R99'")) == "unknown CCD 'R99'"
    with pytest.raises(KeyError):
        raise UnknownNameError("unknown CCD 'R99'")
    assert str(pickle.loads(pickle.dumps(UnknownNameError("no such band", file="a.yaml")))) == "a.yaml: no such band"
