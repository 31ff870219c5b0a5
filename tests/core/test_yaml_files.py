"""YAML: what is written comes back, plain values are what YAML 1.2 says, and errors are said."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.reading import as_yaml, parse_yaml, read_yaml

TEXT = st.text(max_size=10)
LEAVES = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(allow_nan=False), TEXT)
TREES = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=50, database=None, deadline=None, derandomize=True)
@given(TREES)
def test_what_is_written_comes_back(tree):
    assert parse_yaml(as_yaml(tree), "the text") == tree


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e6", 1e6), ("-1E-3", -1e-3), ("010", 10), ("1:30", "1:30"), ("2027-02-30", "2027-02-30"),
        ("2027-01-15T00:00:00Z", "2027-01-15T00:00:00Z"), (".5", 0.5), ("5.", 5.0), ("yes", "yes"),
        ("true", True), ("~", None),
    ],
)  # fmt: skip
def test_numbers_are_decimal_and_dates_are_text(text, value):
    found = parse_yaml(text, "the text")
    assert (type(found), found) == (type(value), value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: 2\na: 3", r"duplicate key \"a\".* \(line 3\)"),
        ("[" * 500 + "]" * 500, "is not valid YAML"),
        ("a: [1", "is not valid YAML"),
        ("!!python/object:os.system {}", "is not valid YAML"),
        ("a\0b", "is not valid YAML"),
    ],
)
def test_what_is_not_valid_is_refused(text, message):
    with pytest.raises(InputError, match=message):
        parse_yaml(text, "the text")


def test_files_are_utf8(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_bytes("a: é".encode("latin-1"))
    with pytest.raises(InputError, match=r"x.yaml cannot be read as a scenario: .*utf-8"):
        read_yaml(path, "a scenario")
    path.write_bytes(b"\xef\xbb\xbfa: 1")
    assert read_yaml(path, "a scenario") == {"a": 1}
