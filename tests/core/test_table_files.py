"""Tables as Parquet: numbers of any byte order, text, truth values, rows of several numbers, units and descriptions."""

import numpy as np
import pytest

from pachon.core.errors import ConfigError
from pachon.core.table_files import parquet_bytes

pyarrow = pytest.importorskip("pyarrow")


def test_columns_and_their_words_are_those_given(tmp_path):
    from pyarrow import parquet

    columns = {
        "a": (np.arange(3, dtype=">f8"), "um", "numbers of FITS"),
        "n": (np.arange(3, dtype=np.int32), "", ""),
        "b": (np.array([True, False, True]), "", ""),
        "t": (np.array(["u", "v", "é"]), "", ""),
        "p": (np.arange(6.0).reshape(3, 2), "mm", ""),
    }
    path = tmp_path / "t.parquet"
    path.write_bytes(parquet_bytes(path, columns, {"pachon": 1}, error=ConfigError))
    table = parquet.read_table(path)
    assert table.to_pydict() == {name: values.tolist() for name, (values, _, _) in columns.items()}
    assert table.schema.field("n").type == pyarrow.int32()
    assert table.schema.field("a").metadata == {b"unit": b"um", b"description": b"numbers of FITS"}
    assert table.schema.field("n").metadata is None
    assert table.schema.metadata == {b"pachon": b"1"}
