"""Read the package's own netCDF files by their declared layouts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import xarray as xr

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.formats import format_of
from lusee_bayes.core.layouts import Content, Layout
from lusee_bayes.core.reading import reading, require_file

# what the CF conventions call times, and what bounds may leave to the variable that they bound
CF_TIME = ("units", "calendar")


def read_netcdf(path: str | Path, format_: str, layout: Layout, hint: str = "") -> Content:
    """Read one of the package's own files.

    Dimensions are told by their names: an array whose dimensions are in another order is turned.
    Attributes of a variable are those of the file by the name ``variable.attribute``.

    Parameters
    ----------
    path : str or Path
    format_ : str
        Its ``format``, one of :mod:`.formats`.
    layout : Layout
    hint : str
        What to do if there is no such file.

    Returns
    -------
    Content

    Raises
    ------
    InputError
        If the file is missing, damaged or of another kind, or not as declared.
    """
    with _opened(path, format_, layout, hint) as dataset:
        return _checked(path, dataset, layout)


def read_dataset(path: str | Path, format_: str, layout: Layout, hint: str = "") -> xr.Dataset:
    """As :func:`read_netcdf`, with the file as a whole: what is not declared, too."""
    with _opened(path, format_, layout, hint) as dataset:
        _checked(path, dataset, layout)
        return dataset.load()


def says(path: Path, attributes: Mapping[str, str]) -> bool:
    """Tell whether a netCDF file of unfinished work is whole, and says so of itself.

    What is damaged is made anew, as what is not there.
    """
    if not path.is_file():
        return False
    try:
        with reading(path, "unfinished work"), xr.open_dataset(path, engine="h5netcdf") as file:
            return all(file.attrs.get(name) == value for name, value in attributes.items())
    except InputError:
        return False


@contextmanager
def _opened(path: str | Path, format_: str, layout: Layout, hint: str) -> Iterator[xr.Dataset]:
    path = require_file(path, layout.what, hint)
    found = format_of(path)
    if found != format_:
        raise InputError(
            f"{path} is not a file of {layout.what}: its format is '{found or 'absent'}', expected "
            f"'{format_}'" + (f"; {hint}" if hint else "")
        )
    with (
        reading(path, layout.what),
        xr.open_dataset(path, engine="h5netcdf", decode_times=False) as dataset,
    ):
        yield dataset


def _decoded(dataset: xr.Dataset, name: str, variable: xr.Variable) -> xr.Variable:
    """Times by the CF conventions: bounds have the units of what they bound, if none of their own.

    Without units they stay numbers.
    """
    bounding = (v.attrs for v in dataset.variables.values() if v.attrs.get("bounds") == name)
    units = {key: v for attrs in bounding for key, v in attrs.items() if key in CF_TIME}
    known = variable.copy(deep=False)
    known.attrs = units | dict(variable.attrs)
    return xr.conventions.decode_cf_variable(name, known)


def _checked(path: str | Path, dataset: xr.Dataset, layout: Layout) -> Content:
    arrays = {str(name): variable for name, variable in dataset.variables.items()}
    for name, declared in layout.variables.items():
        if name not in arrays:
            continue
        array = dataset[name]
        dims = [str(d) for d in declared.dims]
        if array.dims != tuple(dims) and sorted(map(str, array.dims)) == sorted(dims):
            array = array.transpose(*dims)
        variable = array.variable
        arrays[name] = _decoded(dataset, name, variable) if declared.kind == "time" else variable
    said = {f"{name}.{key}": v for name, one in arrays.items() for key, v in one.attrs.items()}
    return layout.checked(path, arrays, said | dataset.attrs)
