"""Draws on disk: what is written comes back, and what cannot be trusted is refused."""

import re

import numpy as np
import pytest
from assertions import raising, refuse, refused

from lusee_bayes.core.errors import InputError
from lusee_bayes.sampling import hmc
from lusee_bayes.sampling.hmc import Checkpoints, Chunk

IDENTITY = {"program": "sky", "sampler's seed": 3, "versions": {"jax": "0.10"}}
N_CHUNKS, N_DRAWS, N_CHAINS = 3, 4, 2


def arrays_of(number):
    """State and draws of one chunk; no two numbers of a run are the same."""
    rng = np.random.default_rng(number)
    state = [
        rng.standard_normal((N_CHAINS, 5)),
        rng.integers(0, 2**32, (N_CHAINS, 2), dtype=np.uint32),
        np.asarray(float(number)),
        *(np.full(1, i) for i in range(12)),  # more than ten: names have to sort as numbers
    ]
    draws = {
        "sky": rng.standard_normal((N_DRAWS, N_CHAINS, 9)),
        "diverging": rng.random((N_DRAWS, N_CHAINS)) > 0.5,
        "with: colon": rng.integers(0, 100, (N_DRAWS, N_CHAINS)),
    }
    return state, draws


@pytest.fixture
def folder(tmp_path):
    """An unfinished run: a chunk of warmup without draws, then chunks with draws."""
    run = Checkpoints(tmp_path / "deep" / "chains", IDENTITY, resume=False)
    run.append(Chunk(N_DRAWS, arrays_of(0)[0], {}))
    for number in range(1, N_CHUNKS + 1):
        run.append(Chunk(N_DRAWS * (number + 1), *arrays_of(number)))
    return run.folder


def again(folder, **changes):
    return Checkpoints(folder, IDENTITY | changes, resume=True)


def chunks(folder):
    return sorted(folder.glob(hmc.CHUNK_GLOB))


def test_a_run_found_again_has_all_its_chunks(folder):
    found = again(folder).chunks()
    assert [chunk.iteration for chunk in found] == [N_DRAWS * (n + 1) for n in range(N_CHUNKS + 1)]
    for number, chunk in enumerate(found):
        state, draws = arrays_of(number)
        for got, leaf in zip(chunk.state, state, strict=True):
            np.testing.assert_array_equal(got, leaf, strict=True)
        assert set(chunk.draws) == (set(draws) if number else set())
        for name, values in chunk.draws.items():
            np.testing.assert_array_equal(values, draws[name], strict=True)


def test_chunks_are_in_the_order_of_their_iterations(tmp_path):
    """9 before 10 before 100000: names are not to be sorted as words."""
    run = Checkpoints(tmp_path, IDENTITY, resume=False)
    for first, last in [(0, 9), (9, 10), (10, 100_000)]:
        run.append(Chunk(last, [], {"x": np.arange(first, last)[:, None]}))
    draws = np.concatenate([chunk.draws["x"] for chunk in run.chunks()])
    np.testing.assert_array_equal(draws[:, 0], np.arange(100_000))
    assert run.chunks()[-1].iteration == 100_000


def test_what_a_kill_left_half_written_is_ignored(folder):
    """The scratch file of a later chunk, cut in the middle, beside the marker's scratch file."""
    half, later = chunks(folder)[-1].read_bytes()[:500], N_DRAWS * (N_CHUNKS + 2)
    (folder / f".chunk-{later:08d}.npz.123.partial").write_bytes(half)
    (folder / ".run.json.123.partial").write_text("{")
    run = again(folder)
    assert len(run.chunks()) == N_CHUNKS + 1
    # and it is in nobody's way when that chunk is written after all
    run.append(Chunk(later, *arrays_of(9)))
    assert run.chunks()[-1].iteration == later


@pytest.mark.parametrize("moment", ["savez", "fsync", "replace"])
def test_a_chunk_is_written_whole_or_not_at_all(folder, monkeypatch, moment):
    """Whatever fails while the file is written, the run is as it was before.

    It is on the disk before it has its name: else a crash could leave the name with nothing in it.
    """
    before = {path.name: path.read_bytes() for path in chunks(folder)}
    run, owner = again(folder), hmc.np if moment == "savez" else hmc.os
    with monkeypatch.context() as patch:
        patch.setattr(owner, moment, raising(OSError("disk full")))
        with pytest.raises(OSError, match="disk full"):
            run.append(Chunk(20, *arrays_of(9)))
    assert {path.name: path.read_bytes() for path in chunks(folder)} == before
    assert not list(folder.glob(".*"))


def test_an_unfinished_run_is_not_touched_without_resume(folder):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    refuse(r"unfinished run \(16 it.*--resume", Checkpoints, folder, IDENTITY, resume=False)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    new = folder.parent / "new"
    assert Checkpoints(new, IDENTITY, resume=False).chunks() == []
    # nothing is lost where nothing was drawn
    assert Checkpoints(new, IDENTITY | {"program": "other"}, resume=False).chunks() == []


ANOTHER_RUN = [
    ({"sampler's seed": 4}, "has another sampler's seed: 3, now 4"),
    ({"program": "sky_marginal"}, "has another program: sky, now sky_marginal"),
    ({"versions": {"jax": "0.11"}}, r"another versions: \{'jax': '0.10'\}, now"),
    ({"program": None}, "another program: sky, now None"),
    ({"program": "sky\n" + "x" * 500}, "has another program: nothing, now xxx"),
]


@pytest.mark.parametrize(("changes", "message"), ANOTHER_RUN)
def test_another_run_is_refused_and_the_difference_named(folder, changes, message):
    identity = {name: value for name, value in (IDENTITY | changes).items() if value is not None}
    with refused(message) as caught:
        Checkpoints(folder, identity, resume=True)
    assert str(folder) in str(caught.value)
    assert len(str(caught.value)) < len(str(folder)) + 250


def test_what_json_makes_of_an_identity_is_the_same_identity(tmp_path):
    """Tuples come back as lists, numbers as keys come back as words."""
    identity = {"turntable": (0.0, 90.0), "table": {1: 0.1}}
    Checkpoints(tmp_path, identity, resume=False).append(Chunk(20, *arrays_of(9)))
    Checkpoints(tmp_path, identity, resume=True)


def one_array(path):
    with path.open("wb") as file:
        np.save(file, np.ones(3))


DAMAGE = {
    "cut": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("not an archive"),
    # inside the first array: 63 bytes of zip header, 128 of numpy's, 80
    "flipped": lambda path: path.write_bytes(
        bytes(b ^ (0xFF if k == 220 else 0) for k, b in enumerate(path.read_bytes()))
    ),
    "other": lambda path: np.savez(path, something=np.ones(3)),
    "one array": one_array,
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_an_unreadable_chunk_is_named_and_deleting_it_helps(folder, damage):
    path = chunks(folder)[-1]
    DAMAGE[damage](path)
    run = again(folder)
    refuse(f"{path} cannot be read.*delete it", run.chunks)
    path.unlink()
    assert run.chunks()[-1].iteration == N_DRAWS * N_CHUNKS


def test_a_chunk_missing_in_the_middle_is_noticed(folder):
    """Draws behind the gap would silently take the place of those in it."""
    chunks(folder)[2].unlink()
    refuse("draws.*iterations 8 to 12", again(folder).chunks)


def test_chunks_without_a_marker_are_not_taken_for_ones_own(folder):
    """What a kill during the folder's removal can leave: chunks of who knows which run."""
    (folder / hmc.IDENTITY).unlink()
    try:
        run = Checkpoints(folder, IDENTITY | {"sampler's seed": 4}, resume=False)
    except InputError:
        return
    assert run.chunks() == []


@pytest.mark.parametrize("content", ["", "{", "[1]"])
def test_an_unreadable_marker_is_bad_input(folder, content):
    (folder / hmc.IDENTITY).write_text(content)
    refuse(re.escape(str(folder)) + ".*delete its folder", again, folder)
