"""Rows of results: what is resumed, what is shared, what is refused."""

import math
import multiprocessing

import pytest

from cablejax.provenance import machine, versions
from rows import Rows, append_row, made_on, read_rows

WANTED = [("a", 1), ("a", 2), ("b", 1), ("b", 2)]


def rows_of(folder) -> Rows:
    return Rows(folder / "new" / "rows.jsonl", ("letter", "number"))


def times(letter, number):
    return {"product": letter * number, "distance": math.inf, "parts": [math.nan, {"low": -math.inf}]}


def test_only_missing_rows_are_made(tmp_path):
    rows, made = rows_of(tmp_path), []
    assert rows.read() == [] and rows.missing(WANTED) == WANTED

    def make(letter, number):
        made.append((letter, number))
        return times(letter, number)

    rows.run(rows.missing(WANTED[:3]), make, progress=False)
    rows.run(rows.missing(WANTED), make, progress=False)
    assert made == WANTED and rows.missing(WANTED) == []
    first = rows.read()[1]
    assert (first["letter"], first["number"], first["product"], first["distance"]) == ("a", 2, "aa", math.inf)
    assert math.isnan(first["parts"][0]) and first["parts"][1] == {"low": -math.inf}


def test_processes_share_the_file(tmp_path):
    rows = rows_of(tmp_path)
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        pool.starmap(append_row, [(rows.path, {"letter": "x" * 5000, "number": n}) for n in range(40)], chunksize=1)
    assert sorted(row["number"] for row in rows.read()) == list(range(40))


def test_no_row_is_begun_when_the_time_is_up(tmp_path):
    rows = rows_of(tmp_path)
    rows.run(WANTED, times, seconds=-1.0, progress=False)
    assert rows.read() == []


def test_the_later_row_of_a_key_counts_in_the_place_of_the_first(tmp_path):
    rows = rows_of(tmp_path)
    for number, value in ((1, "old"), (2, "other"), (1, "new")):
        append_row(rows.path, {"letter": "a", "number": number, "value": value})
    assert [row["value"] for row in rows.read()] == ["new", "other"]
    assert len(read_rows(rows.path)) == 3


def test_a_row_without_its_key_is_refused(tmp_path):
    rows = rows_of(tmp_path)
    append_row(rows.path, {"letter": "a"})
    with pytest.raises(ValueError, match=r"line 1 has no field \['number'\]"):
        rows.read()


def test_rows_say_where_they_were_made(tmp_path):
    rows = rows_of(tmp_path)
    rows.run(WANTED, times, progress=False)
    assert "made_on" not in rows.read()[0]
    here = made_on(rows.path)
    assert here == f"{versions()}; {machine()}."
    append_row(rows.path, {"letter": "c", "number": 1})
    assert made_on(rows.path) == f"4 rows: {here} 1 rows: versions and machine were not kept."
    whose = made_on(rows.path, by=lambda row: "by hand" if len(row) < 3 else "")
    assert whose == f"4 rows: {here} 1 rows (by hand): versions and machine were not kept."
