"""Versions of file formats: which one a file has, and what to do where it is not the one that is read."""

from __future__ import annotations

from cablejax.limits import shown


def version_of(schema: object, known: str, where: object) -> int:
    """The version of a file's schema, at most the known one; the caller migrates what is older.

    Args:
        schema: what the file says, such as "cablejax-weights/1".
        known: name and newest version of the schema that is read.
        where: the file, for messages.

    Raises:
        ValueError: the file has another schema, or a newer version of it.
    """
    name, _, newest = known.partition("/")
    came, _, number = schema.partition("/") if isinstance(schema, str) else ("", "", "")
    if came != name or not number.isascii() or not number.isdecimal() or not 0 < len(number) < 6 or int(number) < 1:
        raise ValueError(f"{where} has schema {shown(schema)}, expected {known!r}: is it another kind of file?")
    if int(number) > int(newest):
        raise ValueError(
            f"{where} has schema {shown(schema)}, expected {known!r} or older: a newer version of cablejax wrote it. "
            "Read it with that version: `pip install --upgrade cablejax`."
        )
    return int(number)
