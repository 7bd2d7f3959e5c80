"""Files with flipped bytes, cut or lengthened, are read or refused in a sentence, and cost no more than their size allows."""

import gzip
import io
import resource
import time
import tracemalloc
import zipfile

import numpy as np
import pytest

from landscape.errors import InputError
from splat.model.files.read import read_splats
from splat.scenes.formats.transforms import read_points
from tests.splat.model.files import written
from tests.splat.model.files.test_quantised import sog, zipped
from tests.splat.model.files.written import FILES, scene

MUTATIONS = 300
SECONDS, BYTES = 5.0, 1 << 30


def mutated(content: bytes, random: np.random.Generator) -> bytes:
    """One of: a few bytes changed (as often in the first 512), a number of four bytes made huge, cut, lengthened."""
    found = bytearray(content)
    reach = len(found) if random.random() < 0.5 else min(len(found), 512)
    match random.integers(4):
        case 0 | 1:
            for place in random.integers(reach, size=random.integers(1, 6)):
                found[place] = random.integers(256)
        case 2:
            place = int(random.integers(max(1, reach - 4)))
            found[place : place + 4] = bytes(
                random.choice(np.array([[255] * 4, [255, 255, 255, 127], [0] * 4, [57] * 4]))
            )
        case _:
            place = int(random.integers(len(found)))
            found = found[:place] if random.random() < 0.7 else found + bytes(found[:place])
    return bytes(found)


def spz_inside(random: np.random.Generator) -> bytes:
    """Mutated before the compression."""
    return gzip.compress(mutated(gzip.decompress(written.spz(scene(1))), random), 1)


def tensors_inside(random: np.random.Generator, content: bytes) -> bytes:
    """The pickle mutated, the checksums right: what a wrong or a hostile program writes."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = next(name for name in members if name.endswith("data.pkl"))
    return zipped({**members, name: mutated(members[name], random)})


def sog_inside(random: np.random.Generator, members: dict[str, bytes]) -> bytes:
    name = list(members)[random.integers(len(members))]
    return zipped({**members, name: mutated(members[name], random)})


def survived(path, contents) -> int:
    """How many of the contents are read; the others are refused."""
    read = sentences = 0
    for number, content in enumerate(contents, 1):
        path.write_bytes(content)
        begun = time.perf_counter()
        try:
            found = read_splats(path)
            assert np.isfinite(found.gaussians.flat.numpy()).all()
            read += 1
        except InputError as error:
            sentences += "\n" not in str(error)
        assert time.perf_counter() - begun < SECONDS
        assert read + sentences == number
    return read


@pytest.mark.parametrize("name", FILES)
def test_mutated_files_of_gaussians_are_read_or_refused(tmp_path, name):
    random, content, path = np.random.default_rng(0), FILES[name](), tmp_path / name
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    tracemalloc.start()
    read = survived(path, (mutated(content, random) for _ in range(MUTATIONS)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert MUTATIONS - read > 0
    assert peak < BYTES
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 < BYTES  # kilobytes; also torch's


@pytest.mark.parametrize("name", [name for name in FILES if name.endswith(("pth", "pt", "ckpt"))])
def test_mutated_pickles_are_read_or_refused(tmp_path, name):
    random, content = np.random.default_rng(3), FILES[name]()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    read = survived(tmp_path / name, (tensors_inside(random, content) for _ in range(MUTATIONS)))
    assert 0 < read < MUTATIONS
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 < BYTES


def test_mutated_quantised_files_are_read_or_refused(tmp_path):
    pytest.importorskip("gsply")
    random, members = np.random.default_rng(1), sog(scene(0))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    read = survived(tmp_path / "a.spz", (spz_inside(random) for _ in range(MUTATIONS)))
    read += survived(tmp_path / "a.sog", (sog_inside(random, members) for _ in range(MUTATIONS)))
    assert 0 < read < 2 * MUTATIONS
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 < BYTES


def test_mutated_points_are_read_or_refused(tmp_path):
    random, path = np.random.default_rng(2), tmp_path / "points.ply"
    content = written.ply(written.columns(scene(0)))
    refused = 0
    for _ in range(MUTATIONS):
        path.write_bytes(mutated(content, random))
        try:
            read_points(path, ())
        except InputError:
            refused += 1
    assert 0 < refused < MUTATIONS
