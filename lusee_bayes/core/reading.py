"""Reading of all files: one that cannot be read raises one sentence with its name.

This module reads JSON, CSV, NumPy's .npz and YAML (version 1.2, except that dates stay text).
"""

import csv
import os
import stat
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import TypeAdapter, ValidationError
from ruamel.yaml import YAML, YAMLError, constructor

from lusee_bayes.core import files, layouts
from lusee_bayes.core.errors import InputError

T = TypeVar("T")
# no person and no part of this package writes a larger text file
LARGEST_TEXT = 50_000_000


def require_file(path: str | Path, what: str, hint: str = "") -> Path:
    """Check that a path is a readable regular file.

    Parameters
    ----------
    path : str or Path
    what : str
        Description of the expected file, for the message.
    hint : str
        Advice in case there is none.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        If there is none, it is a folder, a pipe or a device, or the user may not read it.
    """
    path = files.user_path(path)
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError) as error:
        raise InputError(f"no {_kind(what)} at '{path}'{f'; {hint}' if hint else ''}") from error
    except (OSError, ValueError) as error:
        # the name is too long, contains NUL, or has a file as a parent
        raise InputError(f"no {_kind(what)} at '{path}': {_reason(error)}") from error
    if not stat.S_ISREG(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "neither a file nor a folder"
        raise InputError(f"'{path}' is {kind}; give a file: {what}")
    if not os.access(path, os.R_OK):
        raise InputError(f"'{path}' is not readable by this user; change its permissions")
    return path


@contextmanager
def reading(path: str | Path, what: str, hint: str = "") -> Iterator[Path]:
    """Read a file within the block, and turn any error of a library into one sentence.

    Libraries raise many kinds of errors for truncated or damaged files: HDF5 alone raises OSError,
    KeyError, RuntimeError, ValueError and more. The block should do nothing but read.

    Parameters
    ----------
    path : str or Path
    what : str
        Description of the expected file.
    hint : str
        Advice in case there is none.

    Yields
    ------
    Path

    Raises
    ------
    InputError
        As in :func:`require_file`; and with its reason for any error of the block.
    """
    path = require_file(path, what, hint)
    try:
        with warnings.catch_warnings():
            # about a damaged file, the error is enough
            warnings.simplefilter("ignore")
            yield path
    except (InputError, MemoryError):
        raise
    except Exception as error:
        why = f"{path} cannot be read as {what}: {_reason(error)}; it is damaged or of another kind"
        raise InputError(why) from error


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Put the name of a file, or of another cause, before an InputError of the block."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _kind(what: str) -> str:
    """The description of a file without its article."""
    return what.removeprefix("a ").removeprefix("an ").removeprefix("the ")


def _reason(error: BaseException) -> str:
    """The message of an error on one line, shortened."""
    text = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, KeyError):
        text = text.strip("'\"") if " " in text else f"missing {text}"
    return text if len(text) <= 160 else f"{text[:157]}..."


def read_text(path: str | Path, what: str, hint: str = "") -> str:
    """Read a text file in UTF-8. InputError if it is unreadable or too large."""
    with reading(path, what, hint) as file:
        if (size := file.stat().st_size) > LARGEST_TEXT:
            raise InputError(f"'{path}' has {size:,} bytes; expected {what}")
        text = file.read_bytes().decode("utf-8-sig")
    if "\0" in text:
        raise InputError(f"'{path}' contains NUL bytes; expected {what}")
    return text


def read_model(path: str | Path, kind: type[T], what: str, hint: str = "") -> T:
    """Read JSON into a pydantic model, or into another type that pydantic checks.

    Parameters
    ----------
    path : str or Path
    kind : type
        The model, or for instance dict.
    what : str
        Description of the expected file, for messages.
    hint : str
        Advice in case there is no such file.

    Raises
    ------
    InputError
        If the file cannot be read or violates the model; the message gives the first violation.
    """
    try:
        return TypeAdapter(kind).validate_json(read_text(path, what, hint))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        wrong = f"{path} is not {what}: {f'{where}: ' if where else ''}{first['msg']}"
        raise InputError(wrong) from error


def read_table(path: str | Path, layout: layouts.Layout, hint: str = "") -> dict[str, np.ndarray]:
    """Read a CSV table with a header: columns by name, as numbers if all entries are numbers.

    Raises
    ------
    InputError
        If the file cannot be read, rows differ in length, or a column is missing or not as
        declared.
    """
    with reading(path, layout.what, hint):
        rows = list(csv.reader(read_text(path, layout.what).splitlines(), strict=True))
    if len(rows) < 2:
        raise InputError(f"{path} has no rows; expected {layout.what}")
    header, *rows = rows
    for number, row in enumerate(rows, start=2):
        if len(row) != len(header):
            wrong = f"{path}: line {number} has {len(row)} entries for {len(header)} columns"
            raise InputError(wrong)
    columns: dict[str, np.ndarray] = {}
    texts = {name for name, column in layout.variables.items() if column.kind == "text"}
    for name, values in zip(header, zip(*rows, strict=True), strict=True):
        columns[name] = np.array(values)
        if name not in texts:
            with suppress(ValueError):
                columns[name] = np.array([float(value) if value else np.nan for value in values])
    return columns | layout.checked(path, columns, {}).arrays


def read_arrays(path: str | Path, layout: layouts.Layout, hint: str = "") -> layouts.Content:
    """Read arrays from NumPy's .npz.

    Raises
    ------
    InputError
        If the file cannot be read, or is not as declared.
    """
    # opened here, because NumPy does not close a file that it opened itself and fails to read
    with (
        reading(path, layout.what, hint) as whole,
        whole.open("rb") as file,
        np.load(file, allow_pickle=False) as arrays,
    ):
        if not isinstance(arrays, np.lib.npyio.NpzFile):
            raise InputError(f"{path} contains a single array; expected {layout.what}")
        return layout.checked(path, {name: _unloaded(arrays, name) for name in arrays.files}, {})


def _unloaded(arrays: np.lib.npyio.NpzFile, name: str) -> layouts.Unloaded:
    """The unread array, with shape and dtype from its header."""
    with arrays.zip.open(f"{name}.npy") as file:
        major, _ = np.lib.format.read_magic(file)
        header = getattr(np.lib.format, f"read_array_header_{major}_0")(file)
    return layouts.Unloaded(header[0], header[2], partial(arrays.__getitem__, name))


class _Constructor(constructor.SafeConstructor):
    """The safe constructor, without dates."""


_Constructor.add_constructor("tag:yaml.org,2002:timestamp", lambda _, node: node.value)


def _yaml() -> YAML:
    plain = YAML(typ="safe", pure=True)
    plain.Constructor = _Constructor
    plain.allow_unicode = False  # Unicode line breaks would be lost
    plain.width = sys.maxsize  # folded lines of escaped letters would gain spaces
    plain.sort_base_mapping_type_on_output = False
    return plain


def parse_yaml(text: str, where: str) -> Any:
    """Parse YAML.

    Parameters
    ----------
    text : str
    where : str
        Name of the text, for messages.

    Returns
    -------
    object
        Lists, mappings, numbers, text, booleans and None.

    Raises
    ------
    InputError
        If it is not valid.
    """
    try:
        return _yaml().load(text)
    except (YAMLError, ValueError, RecursionError) as error:
        problem, mark = getattr(error, "problem", None), getattr(error, "problem_mark", None)
        words = " ".join(str(problem or error).split())
        place = "" if mark is None else f" (line {mark.line + 1})"
        raise InputError(f"{where} is not valid YAML: {words}{place}") from error


def read_yaml(path: str | Path, what: str) -> Any:
    """Read a YAML file. InputError if it cannot be read, or as in :func:`parse_yaml`."""
    return parse_yaml(read_text(path, what), str(path))


def table_beside(module: str) -> Any:
    """The table in the YAML file that has the name of a module's file."""
    return read_yaml(Path(module).with_suffix(".yaml"), "a table of the package")


def as_yaml(tree: Any, *, flow: bool = False) -> str:
    """Write lists, mappings and plain values as YAML, on one line if ``flow``."""
    written, plain = StringIO(), _yaml()
    plain.default_flow_style = flow
    plain.dump(tree, written)
    return written.getvalue()
