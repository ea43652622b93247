import sqlite3

import numpy as np
import pytest
from visit_rows import COLUMNS, ROWS


@pytest.fixture
def write_list(tmp_path):
    """Function that writes rows as CSV, changed by column, and returns the path."""

    def write(name="visits.csv", rows=ROWS, drop=(), **columns):
        table = {key: [row[i] for row in rows] for i, key in enumerate(COLUMNS)} | columns
        table = {key: values for key, values in table.items() if key not in drop}
        lines = [",".join(table), *(",".join(map(str, row)) for row in zip(*table.values(), strict=True))]
        path = tmp_path / name
        path.write_text("\n".join(lines) + "\n")
        return path

    return write


@pytest.fixture
def write_database(tmp_path):
    """Function that writes columns as a table of an SQLite database."""

    def write(table, columns, name="visits.db"):
        path = tmp_path / name
        with sqlite3.connect(path) as connection:
            connection.execute(f"CREATE TABLE {table} ({', '.join(columns)})")
            rows = zip(*(np.asarray(values).tolist() for values in columns.values()), strict=True)
            connection.executemany(f"INSERT INTO {table} VALUES ({', '.join('?' * len(columns))})", list(rows))
        connection.close()
        return path

    return write
