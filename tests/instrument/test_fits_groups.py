"""Layout 4 in FITS, in files that astropy has written by the rules of luseepy's writer."""

from __future__ import annotations

import base64
import json
from dataclasses import fields

import h5py
import numpy as np
import pytest
from astropy.io import fits
from test_session_writing import N, some_counts, some_rows

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.fits_files import opened
from lusee_bayes.instrument.flight.fits_groups import FITSGroups
from lusee_bayes.instrument.flight.session_writing import write_session
from lusee_bayes.instrument.flight.sessions import is_session, read_session

LETTERS = {"i2": "I", "i4": "J", "i8": "K", "u1": "B", "u2": "I", "u4": "J", "u8": "K",
           "f4": "E", "f8": "D", "c8": "C", "c16": "M", "b1": "L"}  # fmt: skip


def said(value):
    """An attribute in JSON."""
    if isinstance(value, str):
        return {"encoding": "utf8", "value": value}
    array = np.asarray(value)
    more = {"dtype": array.dtype.str, "shape": list(array.shape)}
    if array.dtype.kind == "U":
        return {"encoding": "utf8_array", "values": array.ravel().tolist(), **more}
    return {"encoding": "raw", "data": base64.b64encode(array.tobytes()).decode(), **more}


def column(name, array, attributes=None):
    """A column as astropy makes it, and what COLJSON says of it."""
    about = {"logical_dtype": array.dtype.str, "logical_shape": list(array.shape)}
    about["attrs"] = {key: said(value) for key, value in (attributes or {}).items()}
    kind, zero, stored = array.dtype.kind, None, array
    if 0 in array.shape[1:]:
        about["encoding"], stored = "empty", np.zeros((len(array), 1), dtype=np.uint8)
    elif kind in "US":
        if kind == "U":
            about["logical_dtype"], array = "utf8", np.char.encode(array, "utf-8")
        width = array.dtype.itemsize
        stored = np.frombuffer(array.tobytes(), np.uint8).reshape(*array.shape, width)
        about |= {"U": {"encoding": "utf8", "utf8_width": width},
                  "S": {"encoding": "bytes", "itemsize": width}}[kind]  # fmt: skip
    elif array.dtype == np.int8:
        about["encoding"], stored = "int8", array.astype(np.int16)
    else:
        about["encoding"] = "unsigned" if kind == "u" else "native"
    if kind == "u":
        zero = 1 << (8 * array.dtype.itemsize - 1) if array.dtype.itemsize > 1 else None
        about["bzero"] = zero
    letter = LETTERS[stored.dtype.str[1:]]
    inner = stored.shape[1:]
    about["tform"] = f"{np.prod(inner)}{letter}" if np.prod(inner, dtype=int) != 1 else letter
    dim = f"({','.join(map(str, inner[::-1]))})" if inner else None
    return fits.Column(name, about["tform"], array=stored, dim=dim, bzero=zero), about


def table(path, arrays, of=None, **words):
    """An extension with arrays, and what these say of themselves."""
    columns, schema = [], {}
    for name, array in sorted(arrays.items()):
        short = name if len(name) <= 60 else "__L4C0001"
        made, schema[name] = column(short, array, (of or {}).get(name))
        columns.append(made)
        if short != name:
            schema[name]["transport_name"] = short
    hdu = fits.BinTableHDU.from_columns(columns)
    hdu.header.update({"LUSEEKND": "table", "LUSEEPTH": path, **words})
    hdu.header["COLJSON"] = json.dumps(schema, sort_keys=True, separators=(",", ":"))
    return hdu


def group(path):
    hdu = fits.ImageHDU()
    hdu.header.update({"LUSEEKND": "group", "LUSEEPTH": path})
    return hdu


def write(path, hdus, layout=4, version=1):
    """A file of extensions, each with its attributes."""
    primary = fits.PrimaryHDU()
    primary.header.update({"LAYOUTV": layout, "FITSFMT": version, "LUSEEKND": "primary"})
    primary.header.update({"LUSEEPTH": "/", "ATTRJSON": json.dumps({"quality": said("clean")})})
    for number, (hdu, attributes) in enumerate(hdus, start=1):
        hdu.header["EXTNAME"] = f"L4G{number:04d}"
        if hdu.header["LUSEEKND"] != "table-part":
            about = {key: said(value) for key, value in attributes.items()}
            hdu.header["ATTRJSON"] = json.dumps(about, separators=(",", ":"))
    made = fits.HDUList([primary, *(hdu for hdu, _ in hdus)])
    made.writeto(path, checksum=True, overwrite=True)
    return path


def of_hdf5(path, to):
    """A file of FITS with what one of HDF5 holds."""
    hdus = []

    def visit(name, item):
        if isinstance(item, h5py.Dataset):
            return
        own = {key: one for key, one in item.items() if isinstance(one, h5py.Dataset)}
        text = {key for key, one in own.items() if h5py.check_string_dtype(one.dtype)}
        arrays = {
            key: one.asstr()[()].astype(str) if key in text else one[()] for key, one in own.items()
        }
        lengths = {len(array) for array in arrays.values()}
        about = {key: dict(one.attrs) for key, one in own.items()}
        if len(lengths) == 1:
            hdus.append((table(f"/{name}", arrays, about), dict(item.attrs)))
            return
        hdus.append((group(f"/{name}"), dict(item.attrs)))
        for part, n in enumerate(sorted(lengths)):
            some = {key: array for key, array in arrays.items() if len(array) == n}
            words = {"LUSEEKND": "table-part", "LUSEEPRT": part}
            hdus.append((table(f"/{name}", some, about, **words), {}))

    with h5py.File(path) as file:
        file.visititems(visit)
    return write(to, hdus)


ARRAYS = {
    "bits": np.array([True, False, True]),
    "floats": np.array([[1.5, np.nan], [-np.inf, 0.0], [3e-39, 1.0]], dtype=np.float32),
    "large": np.array([0, 2**63, 2**64 - 1], dtype=np.uint64),
    "middle": np.array([[0, 2**31], [2**32 - 1, 1], [5, 6]], dtype=np.uint32),
    "small": np.array([0, 2**15, 2**16 - 1], dtype=np.uint16),
    "bytes": np.array([0, 128, 255], dtype=np.uint8),
    "signed": np.array([[-128], [0], [127]], dtype=np.int8),
    "short": np.array([-(2**15), 0, 7], dtype=np.int16),
    "long": np.array([-(2**63), 0, 2**63 - 1]),
    "complex": np.array([1.0 + 2.0j, -1.0j, 0.0]),
    "texts": np.array([["µ", ""], ["spectrometer", "dcb"], ["a b", "°C"]]),
    "raw": np.array([b"ab", b"", b"\xff\x01c"]),
    "nothing": np.empty((3, 0, 4)),
    "cube": np.arange(36, dtype=np.float64).reshape(3, 3, 4),
    "a_name_that_is_longer_than_sixty_characters_and_so_has_another_one_in_fits": np.arange(3),
}


def test_every_encoding_is_decoded(tmp_path):
    about = {"cube": {"units": "K", "scale": np.float32(0.1), "names": np.array(["a", "bc"])}}
    others = {"other": np.arange(5, dtype=np.int32)}
    parts = {"LUSEEKND": "table-part"}
    # rows of more than a page: what is next to the spectra is read without them
    wide = {"data": np.arange(6000.0).reshape(3, 2, 1000), "later": np.arange(6).reshape(3, 2)}
    hdus = [
        (table("/one", ARRAYS, about), {"count": np.uint64(3), "text": "it's a 'µ' " + 200 * "x"}),
        (group("/one/two"), {"axes": np.array([[1, 2], [3, 4]], dtype=np.int16)}),
        (table("/one/two", others, LUSEEPRT=0, **parts), {}),
        (table("/one/two", {"more": np.arange(2.0)}, LUSEEPRT=1, **parts), {}),
        (table("/wide", wide), {}),
    ]
    path = write(tmp_path / "all.fits", hdus)
    with opened(path) as found:
        tree = FITSGroups(path, found)
        for name, expected in ARRAYS.items():
            array = tree.array(f"one/{name}")
            values = np.asarray(array)
            assert array.shape == values.shape == expected.shape, name
            assert values.dtype.kind == expected.dtype.kind, name
            assert expected.dtype.kind == "U" or values.dtype == expected.dtype, name
            np.testing.assert_array_equal(values, expected)
            np.testing.assert_array_equal(array.rows(1, 3), expected[1:3])
        for name, expected in wide.items():
            np.testing.assert_array_equal(tree.array(f"wide/{name}"), expected)
            np.testing.assert_array_equal(tree.array(f"wide/{name}").rows(1, 3), expected[1:3])
        assert tree.attributes("") == {"quality": "clean"}
        assert tree.attributes("one")["count"] == 3
        assert tree.attributes("one")["text"] == "it's a 'µ' " + 200 * "x"
        cube = tree.attributes("one/cube")
        assert (cube["units"], cube["scale"]) == ("K", np.float32(0.1))
        np.testing.assert_array_equal(cube["names"], ["a", "bc"])
        np.testing.assert_array_equal(tree.attributes("one/two")["axes"], [[1, 2], [3, 4]])
        np.testing.assert_array_equal(tree.array("one/two/other"), np.arange(5))
        np.testing.assert_array_equal(tree.array("one/two/more"), [0.0, 1.0])
        assert tree.names("") == ["one", "wide"]
        assert set(tree.names("one")) == {*ARRAYS, "two"}
        assert tree.array("one/none") is None
        assert not tree.attributes("none")
    assert is_session(path)
    with pytest.raises(InputError, match=r"has no spectra/data.*it has one, wide"):
        read_session(path)


@pytest.fixture(scope="module")
def hdf5(tmp_path_factory):
    """A session of layout 4 in HDF5."""
    path = tmp_path_factory.mktemp("sessions") / "session.h5"
    counts = some_counts()
    counts[2, 3] = np.nan
    return write_session(path, some_rows(), [counts], layout=4)


def require_same(one, other):
    """Sessions that hold the same, bit by bit, in whatever files."""
    for field in fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if isinstance(a, np.ndarray):
            assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()), field.name
        elif field.name == "telemetry":
            assert a.keys() == b.keys()
            assert all(a[key].tobytes() == b[key].tobytes() for key in a)
        elif field.name == "clock":
            assert (a.jd1, a.jd2, a.scale, a.raw_s) == (b.jd1, b.jd2, b.scale, b.raw_s)
        elif field.name not in ("path", "kind", "opener"):
            assert a == b, field.name
    with one.spectra() as first, other.spectra() as second:
        assert first(0, N).tobytes() == second(0, N).tobytes()
        assert first(3, 5).tobytes() == second(3, 5).tobytes()


def test_a_session_is_the_same_in_hdf5_and_in_fits(hdf5, tmp_path):
    """astropy's columns and ours, which are written row by row."""
    made = of_hdf5(hdf5, tmp_path / "made.fits")
    counts = read_session(hdf5)
    with counts.spectra() as read:
        blocks = [read(0, 4), read(4, N)]
    ours = write_session(tmp_path / "ours.fits", some_rows(), blocks, kind="fits", layout=4)
    require_same(read_session(hdf5), read_session(made))
    require_same(read_session(hdf5), read_session(ours))
    assert read_session(ours).kind == "FITS"
    with fits.open(made) as theirs, fits.open(ours) as mine:
        mine.verify("exception")
        assert [hdu.name for hdu in mine] == [hdu.name for hdu in theirs]
        for a, b in zip(mine[1:], theirs[1:], strict=True):
            assert a.header["LUSEEPTH"] == b.header["LUSEEPTH"]
            assert json.loads(a.header["ATTRJSON"]) == json.loads(b.header["ATTRJSON"]) \
                if "ATTRJSON" in b.header else a.header["LUSEEKND"] == "table-part"  # fmt: skip
            if isinstance(b, fits.BinTableHDU):
                assert json.loads(a.header["COLJSON"]) == json.loads(b.header["COLJSON"])
                # the same columns, in astropy's words
                assert [str(c) for c in a.columns] == [str(c) for c in b.columns]
                for name in b.columns.names:
                    np.testing.assert_array_equal(a.data[name], b.data[name])


# of luseepy's own files
TYPES = {
    "spectra/data": "float32",
    "spectra/mjd_time_valid": "bool",
    "spectra/navgf": "uint8",
    "spectra/original_indices": "uint64",
    "spectra/raw_seconds": "float64",
    "spectra/unique_ids": "uint32",
    "spectra/metadata/field_present/notch": "bool",
    "spectra/metadata/fields/actual_gain/variant_000/data": "uint8",
    "spectra/metadata/fields/actual_gain/variant_000/row_indices": "uint64",
    "spectra/metadata/fields/adc_min/variant_000/data": "int64",
    "spectra/metadata/fields/navg2_shift/variant_index": "int32",
    "spectra/metadata/fields/requested_bitslice/variant_000/data": "uint8",
    "telemetry/lusee_subsecs": "uint16",
    "telemetry/mission_seconds": "uint32",
    "telemetry/values": "float64",
}


def test_names_and_types_are_luseepys(hdf5):
    with h5py.File(hdf5) as file:
        assert {name: str(file[name].dtype) for name in TYPES} == TYPES
        assert file.attrs["layout_version"].dtype == np.uint16
        assert file["spectra"].attrs["count"].dtype == np.uint64
        assert file["spectra/data"].attrs["bitslice_restored"].dtype == np.bool_
        assert file["spectra/data"].attrs["bitslice_reference"].dtype == np.uint8
        assert file["session_invariants"].attrs["software_version"].dtype == np.uint32


def changed(path, change):
    """Change an extension, which is found by its path."""
    with fits.open(path) as hdus:
        kept = fits.HDUList([hdu.copy() for hdu in hdus])
    change({hdu.header["LUSEEPTH"]: hdu for hdu in kept}, kept)
    kept.writeto(path, overwrite=True)
    return path


def word(group_path, key, old, new):
    def change(by_path, _):
        header = by_path[group_path].header
        value = header[key]
        header[key] = value.replace(old, new) if isinstance(value, str) else new
        assert header[key] != value

    return change


def without(name):
    """Its number is given to the next."""

    def change(by_path, hdus):
        del hdus[hdus.index(by_path[name])]
        for number, hdu in enumerate(hdus[1:], start=1):
            hdu.name = f"L4G{number:04d}"

    return change


REFUSED = {
    "FITSFMT is 2": word("/", "FITSFMT", 1, 2),
    "layout 5; this version reads 3 and 4": word("/", "LAYOUTV", 4, 5),
    "should be L4G0003: one is missing": lambda _, hdus: hdus.pop(3),
    "has the path of another one, /spectra": word(
        "/session_invariants", "LUSEEPTH", "session_invariants", "spectra"
    ),
    "of the kind 'tables'": word("/spectra", "LUSEEKND", "table", "tables"),
    "column data is not what COLJSON says": word("/spectra", "COLJSON", "[7,16,", "[7,8,"),
    "column navgf is not what COLJSON says": word("/spectra", "COLJSON", "|u1", "|i1"),
    "no column date, which COLJSON lists": word(
        "/spectra", "COLJSON", '"tform":"32768E"', '"tform":"32768E","transport_name":"date"'
    ),
    "has no spectra/raw_times": word("/spectra", "COLJSON", '"raw_seconds"', '"other"'),
    "has no spectra/data": without("/spectra"),
    "has no constants.lun_lat_deg": without("/constants"),
    "has no spectra/metadata/adc_min": without("/spectra/metadata/fields/adc_min/variant_000"),
    "telemetry has no values": word("/telemetry", "COLJSON", '"values"', '"readings"'),
    "encoded as raws": word("/spectra", "ATTRJSON", '"raw"', '"raws"'),
}


@pytest.mark.parametrize("told", REFUSED)
def test_what_is_no_session_is_refused(hdf5, tmp_path, told):
    path = write_session(tmp_path / "s.fits", some_rows(), [some_counts()], kind="fits", layout=4)
    changed(path, REFUSED[told])
    with pytest.raises(InputError, match=told.replace("(", r"\(")) as refused:
        read_session(path)
    assert "\n" not in str(refused.value)
    assert str(path) in str(refused.value)


def test_a_file_that_is_cut_short_is_refused(tmp_path):
    path = write_session(tmp_path / "s.fits", some_rows(), [some_counts()], kind="fits", layout=4)
    session, whole = read_session(path), path.read_bytes()
    for share in (0.1, 0.6, 0.95):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError, match="cut short, damaged|no spectra/data"):
            read_session(path)
    with pytest.raises(InputError, match="cut short"), session.spectra() as read:
        read(0, N)
