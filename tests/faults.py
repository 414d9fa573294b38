"""Files with one fault, and the error that reports it."""

from contextlib import contextmanager

import pytest

from pkmcal.errors import InputError


def written(path, content):
    """A file with this content, text or bytes; returns its path."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def replaced(path, old, new, count=-1):
    """A file with a part of its text replaced, which has to be there."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))


def fault(function, *arguments, **keywords):
    """The message of the InputError that a call raises."""
    with pytest.raises(InputError) as caught:
        function(*arguments, **keywords)
    return str(caught.value)


@contextmanager
def raises(kind, **fields):
    """`pytest.raises` for an error of pkmcal whose fields, such as code and where, are these."""
    with pytest.raises(kind) as caught:
        yield caught
    raised = {name: getattr(caught.value, name) for name in fields}
    assert raised == fields, f"{raised} instead of {fields}: {caught.value}"
