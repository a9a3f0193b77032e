"""A place for data sets in object storage, `s3://BUCKET/PREFIX`, by obstore."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import functools
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cablejax.extras import from_extra

if TYPE_CHECKING:
    from obstore.store import S3Store
    from zarr.storage import ObjectStore

_RETRIES, _SECONDS = 4, 30
"""How often a request is repeated, and for how long, before the storage counts as out of reach."""


class UnreachableError(ValueError):
    """Object storage does not answer, or refuses; the message says what was asked and how to go on."""


def place_of(path: str | os.PathLike[str] | Bucket) -> Path | Bucket:
    """A folder, or a bucket's prefix where the path begins with `s3://`; `pathlib` makes one slash of the two."""
    if isinstance(path, Bucket):
        return path
    text = os.fspath(path)
    found = re.fullmatch(r"s3:/{1,2}([^/].*?)/*", text, re.IGNORECASE)
    if not found and text.lower().startswith("s3:"):
        raise ValueError(f"{text} is not an address in object storage, expected s3://BUCKET/PREFIX.")
    return Bucket(f"s3://{found[1]}") if found else Path(path)


@dataclasses.dataclass(frozen=True)
class Bucket:
    """Objects under one prefix. Address and keys come from AWS_ENDPOINT_URL, AWS_ACCESS_KEY_ID and the like.

    Every object is written whole or not at all. There are no locks: each share of a data set is for one process.

    Attributes:
        url: `s3://BUCKET/PREFIX`.
    """

    url: str

    def __str__(self) -> str:
        return self.url

    @property
    def name(self) -> str:
        """The last part of the prefix."""
        return self.url.rpartition("/")[2]

    def _obstore(self, module: str = "obstore") -> Any:
        return from_extra(module, "cluster", f"{self.url} needs obstore", UnreachableError)

    @functools.cached_property
    def _objects(self) -> S3Store:
        endpoint = os.environ.get("AWS_ENDPOINT_URL", "")
        with self.reached():
            return self._obstore("obstore.store").S3Store.from_url(
                self.url,
                client_options={
                    "timeout": "30s",
                    "connect_timeout": "5s",
                    "allow_http": endpoint.startswith("http://"),
                },
                retry_config={"max_retries": _RETRIES, "retry_timeout": datetime.timedelta(seconds=_SECONDS)},
            )

    def zarr(self, *, read_only: bool) -> ObjectStore[Any]:
        """The objects as a store of zarr."""
        from zarr.storage import ObjectStore

        return ObjectStore(self._objects, read_only=read_only)

    def read(self, name: str) -> bytes | None:
        """One object, or None if there is none of this name."""
        with self.reached():
            try:
                return bytes(self._obstore().get(self._objects, name).bytes())
            except FileNotFoundError:
                return None

    def write(self, name: str, content: bytes) -> None:
        """Writes one object, over what was there."""
        with self.reached():
            self._obstore().put(self._objects, name, content)

    def names(self, prefix: str | None = None) -> list[str]:
        """All objects, or those in a folder of this name."""
        with self.reached():
            return [item["path"] for batch in self._obstore().list(self._objects, prefix) for item in batch]

    def remove(self, names: list[str]) -> None:
        """Removes objects."""
        with self.reached():
            if names:
                self._obstore().delete(self._objects, names)

    @contextlib.contextmanager
    def reached(self) -> Iterator[None]:
        """Around requests: raises `UnreachableError` where the storage does not answer or refuses."""
        refused = self._obstore("obstore.exceptions").BaseError
        try:
            yield
        except FileNotFoundError:
            raise
        except (refused, OSError) as error:
            reason = next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
            raise UnreachableError(
                f"{self.url} cannot be reached: {reason[:300]}. Check AWS_ENDPOINT_URL, the keys and the connection. "
                "Complete shards are kept: run the same command again to resume."
            ) from error
