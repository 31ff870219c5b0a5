"""What an object is, in about three lines: for a prompt, and for a notebook."""

from __future__ import annotations

from abc import abstractmethod
from html import escape
from typing import Any

import numpy as np

from lusee_bayes.core.checks import is_traced


class Described:
    """An object that says what it is: its kind, shapes, units, frequencies, dates.

    Dataclasses need ``repr=False``, or they write a representation of their own.
    """

    @abstractmethod
    def description(self) -> tuple[str, ...]:
        """Return a few lines: first what the object is, then what it holds."""

    def __repr__(self) -> str:
        first, *rest = self.description()
        return "\n  ".join([f"{type(self).__name__}: {first}", *rest])

    def _repr_html_(self) -> str:
        first, *rest = self.description()
        lines = "".join(f"<br>{escape(line)}" for line in rest)
        return f"<div><b>{escape(type(self).__name__)}</b>: {escape(first)}{lines}</div>"


def number(value: Any, form: str = ".6g") -> str:
    """Return a number as text; of a tracer, whose value is not known, that it is one."""
    return "traced" if is_traced(value) else format(float(value), form)


def extent(values: Any, unit: str, form: str = ".4g") -> str:
    """Return the smallest and the largest of some numbers with their unit."""
    if is_traced(values):
        return f"values in {unit}, traced"
    values = np.asarray(values)
    return f"{values.min():{form}} to {values.max():{form}} {unit}"


def listed(names: tuple[str, ...], shown: int = 4) -> str:
    """Return names one after the other, the middle of many left out."""
    if len(names) <= 2 * shown:
        return ", ".join(names)
    return ", ".join([*names[:shown], "...", *names[-2:]])


def counted(n: int, one: str, several: str = "") -> str:
    """Return a number with its noun: 1 session, 2 sessions."""
    return f"{n} {one if n == 1 else several or f'{one}s'}"
