"""Pages in Markdown: what is printed is what is written."""

from cablejax.provenance import machine, versions
from pages import markdown_table, page_of_results, publish


def test_table_has_a_title_and_as_many_dashes_as_columns():
    assert markdown_table([["a", "b"], ["1", "2"]]) == ["| a | b |", "| --- | ---: |", "| 1 | 2 |"]


def test_page_is_printed_and_written_to_a_folder_that_is_made(tmp_path, capsys):
    text, out = "# Error in µm\n", tmp_path / "results" / "page.md"
    publish(text, out)
    assert out.read_text(encoding="utf-8") == text
    assert capsys.readouterr().out == text + "\n"


def test_page_without_a_file_is_only_printed(capsys):
    publish("# Title", None)
    assert capsys.readouterr().out == "# Title\n"


def test_page_says_how_and_where_it_was_made():
    lines = page_of_results("Title", "`python x.py`, after `y`", ["About.", ""]).splitlines()
    assert lines == ["# Title", "", "Made by `python x.py`, after `y`.", f"{versions()}; {machine()}.", "", "About."]
    assert page_of_results("Title", "`x`", ["About."], made_on="One core.").splitlines()[3] == "One core."
