"""Data sets in object storage: against an S3 server on loopback, with a connection that is cut on the way."""

import contextlib
import dataclasses
import json
import shutil
import socket
import subprocess
import sys
import threading
import time
import urllib.request

import numpy as np
import pytest

from cablejax.cable import Cable, Discretisation
from cablejax.cable_file import read_cable
from cablejax.cli import main
from cablejax.commands.simulate import _clear
from cablejax.dataset.bucket import Bucket, UnreachableError, place_of
from cablejax.dataset.generate import generate
from cablejax.dataset.opening import open_or_create, open_store
from cablejax.dataset.schema import DatasetConfig
from cablejax.dataset.split import read_split
from cablejax.dataset.store import Store
from cablejax.simulate.motions import MotionConfig

TINY = DatasetConfig(
    n_trajectories=7,
    n_steps=3,
    shard_size=2,
    seed=5,
    motion=MotionConfig(max_step=0.03, min_distance=0.6, max_angle=0.6, max_curvature=3.0),
    discretisation=Discretisation(Cable(n_keypoints=4), n_links=7, timestep=0.05),
)


class Wire:
    """Passes bytes on to a server, until it is cut."""

    def __init__(self, port: int):
        self.server, self.cut_after, self.open = port, None, []
        self.place = socket.create_server(("127.0.0.1", 0))
        self.port = self.place.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """Ends all connections, and all that come."""
        self.cut_after = 0
        for end in self.open:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)  # wakes whoever waits there
            end.close()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self.place.accept()
                if self.cut_after is not None and self.cut_after <= 0:
                    client.close()
                    continue
                server = socket.create_connection(("127.0.0.1", self.server))
            except OSError:
                return
            self.open += [client, server]
            threading.Thread(target=self._pass, args=(client, server, True), daemon=True).start()
            threading.Thread(target=self._pass, args=(server, client, False), daemon=True).start()

    def _pass(self, one: socket.socket, other: socket.socket, counted: bool) -> None:
        try:
            while piece := one.recv(4096):
                if counted and self.cut_after is not None:
                    self.cut_after -= len(piece)
                    if self.cut_after <= 0:
                        self.cut()
                        return
                other.sendall(piece)
        except OSError:
            pass
        finally:
            other.close()


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """The port of moto's S3 server, which lives in an environment of its own: its pins are not ours."""
    program = shutil.which("moto_server")
    if program is None:
        pytest.skip("needs moto_server on the path: make moto")
    pytest.importorskip("obstore")
    with socket.create_server(("127.0.0.1", 0)) as place:
        port = place.getsockname()[1]
    with (tmp_path_factory.mktemp("s3") / "log").open("w") as log:
        process = subprocess.Popen([program, "-H", "127.0.0.1", "-p", str(port)], stdout=log, stderr=log)
    try:
        for _ in range(300):
            try:
                request = urllib.request.Request(f"http://127.0.0.1:{port}/cables", method="PUT")
                urllib.request.urlopen(request, timeout=5).close()
                break
            except OSError:
                time.sleep(0.1)
        yield port
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def wire(server, monkeypatch):
    one = Wire(server)
    for name, value in (
        ("AWS_ENDPOINT_URL", f"http://127.0.0.1:{one.port}"),
        ("AWS_ACCESS_KEY_ID", "a"),
        ("AWS_SECRET_ACCESS_KEY", "b"),
        ("AWS_REGION", "us-east-1"),
    ):
        monkeypatch.setenv(name, value)
    yield one
    one.cut()
    one.place.close()


def test_a_bucket_holds_what_a_folder_holds(wire, tmp_path, monkeypatch):
    local = generate(TINY, tmp_path / "data.zarr", progress=False)
    shares = [generate(TINY, "s3://cables/data.zarr", process_index=k, process_count=2, progress=False) for k in (0, 1)]
    assert not shares[0].complete and shares[1].complete and shares[1].digest == local.digest
    (here, _), (there, held_out) = read_split([tmp_path / "data.zarr"]), read_split(["s3://cables/data.zarr"])
    np.testing.assert_array_equal(here.keypoints, there.keypoints)
    assert len(held_out[0].keypoints) == 1
    with pytest.raises(ValueError, match=r"holds a data set of another configuration: .*seed is 5"):
        open_or_create("s3://cables/data.zarr", dataclasses.replace(TINY, seed=6))
    with pytest.raises(ValueError, match=r"s3://cables/none holds no data set"):
        open_store("s3://cables/none")
    # another process is done just after this one has looked
    read, looks = Bucket.read, iter([None])
    monkeypatch.setattr(Bucket, "read", lambda self, name: next(looks, read(self, name)))
    assert open_or_create("s3://cables/data.zarr", TINY).info().complete
    monkeypatch.setattr(Bucket, "read", read)
    Bucket("s3://cables/other").write("letter.txt", b"hello")
    with pytest.raises(ValueError, match="holds objects, but no data set"):
        open_or_create("s3://cables/other", TINY)
    _clear(Bucket("s3://cables/data.zarr"), TINY)
    assert open_store("s3://cables/data.zarr").config == TINY
    _clear(Bucket("s3://cables/data.zarr"), dataclasses.replace(TINY, seed=6))
    with pytest.raises(ValueError, match=r"s3://cables/data.zarr holds no data set"):
        open_store("s3://cables/data.zarr")
    with pytest.raises(ValueError, match=r"s3://cables/other holds no data set"):
        _clear(Bucket("s3://cables/other"), TINY)


def test_what_is_damaged_in_a_bucket_is_made_again(wire):
    info = generate(TINY, "s3://cables/damaged", progress=False)
    bucket = Bucket("s3://cables/damaged")
    shard = next(name for name in bucket.names() if name.startswith("keypoints/c/1/"))
    bucket.write(shard, b"nonsense")
    bucket.remove(["digest/zarr.json"])
    with pytest.raises(ValueError, match="damaged: digest cannot be used"):
        open_store(bucket)
    assert generate(TINY, bucket, progress=False) == info
    assert [open_store(bucket).status(k) for k in range(4)] == ["complete"] * 4


def test_a_cut_connection_is_a_message_and_what_was_done_is_kept(wire, tmp_path, monkeypatch):
    store = open_or_create("s3://cables/cut", TINY)
    write, written = Store.write_shard, []

    def cut_at_the_third(self, shard, block):
        if len(written) == 2:
            wire.cut_after = 2000  # in the middle of this shard
        written.append(shard)
        write(self, shard, block)

    monkeypatch.setattr(Store, "write_shard", cut_at_the_third)
    with pytest.raises(UnreachableError, match=r"s3://cables/cut cannot be reached: .*run the same command again"):
        generate(TINY, "s3://cables/cut", progress=False)
    assert written == [0, 1, 2]
    wire.cut_after = None
    assert [store.status(k) for k in (0, 1, 3)] == ["complete", "complete", "missing"]
    assert store.status(2) != "complete"
    info = generate(TINY, "s3://cables/cut", progress=False)
    assert written == [0, 1, 2, 2, 3]
    assert info.digest == generate(TINY, tmp_path / "whole", progress=False).digest


def test_reading_over_a_cut_connection_says_so_and_damages_nothing(wire):
    info = generate(TINY, "s3://cables/read", progress=False)
    store = open_store("s3://cables/read")
    wire.cut()
    for read in (store.read, store.info, lambda: store.status(0), lambda: generate(TINY, store.path, progress=False)):
        with pytest.raises(UnreachableError, match="cannot be reached"):
            read()
    wire.cut_after = None
    assert open_store("s3://cables/read").info() == info


def test_commands_take_buckets(wire, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = ["simulate", "--out", "s3://cables/cli.zarr", "--trajectories", "4", "--steps", "24", "--links", "5"]
    assert main([*small, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["path"] == "s3://cables/cli.zarr" and result["complete"] == 4
    assert main(["view", "s3://cables/cli.zarr"]) == 0 and (tmp_path / "cli.html").is_file()
    assert main(["cable", "--from", "s3://cables/cli.zarr", "--out", "cable.toml"]) == 0
    assert read_cable(tmp_path / "cable.toml") == Cable()
    capsys.readouterr()
    wire.cut()
    assert main(small) == 2
    assert "s3://cables/cli.zarr cannot be reached" in capsys.readouterr().err


@pytest.mark.slow
def test_a_training_reads_a_bucket(wire, tmp_path):
    bucket = "s3://cables/trained.zarr"
    assert main(["simulate", "--out", bucket, "--trajectories", "4", "--steps", "24", "--links", "5"]) == 0
    train = ["train", "--data", bucket, "--out", str(tmp_path / "train"), "--preset", "smoke"]
    assert main([*train, "--steps", "2", "--latent", "8", "--message-passing", "1"]) == 0
    assert "cablejax train --data trained.zarr" in (tmp_path / "train" / "card.md").read_text()


def test_places():
    assert place_of("s3://a/b/c.zarr/") == place_of("s3:/a/b/c.zarr") == Bucket("s3://a/b/c.zarr")
    assert Bucket("s3://a/b/c.zarr").name == "c.zarr" and str(place_of("runs/s3:/x")) == "runs/s3:/x"
    assert place_of("S3://a/b") == Bucket("s3://a/b")
    for wrong in ("s3://", "s3:///a/b", "s3:a"):
        with pytest.raises(ValueError, match="not an address in object storage, expected s3://BUCKET/PREFIX"):
            place_of(wrong)


def test_without_its_library_object_storage_says_what_to_install(monkeypatch):
    for name in ("obstore", "obstore.store", "obstore.exceptions"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(UnreachableError, match=r"s3://a/b needs obstore: pip install 'cablejax\[cluster\]'"):
        Bucket("s3://a/b").names()
