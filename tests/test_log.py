"""Renamed keyword arguments: the old name works with a warning, and both names together are refused."""

import warnings

import pytest

from nnap_em.diagnosis.search import diagnose
from nnap_em.experiment.experiment import design
from nnap_em.storage.log import renamed, silent


@renamed(say="log")
def logged(text, *, log=silent):
    """Hand a line to the receiver."""
    log(text)


def test_the_old_name_of_an_argument_gives_the_same_with_a_warning():
    lines, same = [], []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        logged("epoch 1", log=lines.append)
    with pytest.warns(DeprecationWarning, match=r"logged\(say=\) is now log="):
        logged("epoch 1", say=same.append)
    assert lines == same == ["epoch 1"]


@pytest.mark.parametrize("function", [diagnose, design])
def test_public_functions_refuse_both_names_of_an_argument(function):
    with pytest.raises(TypeError, match="'log' and its old name 'say'"):
        function(None, None, key=None, log=silent, say=silent)


@pytest.mark.parametrize("function", [diagnose, design])
def test_public_functions_accept_the_old_name(function):
    """The warning comes before the arguments are read; the key is none, so that nothing is computed."""
    message = rf"{function.__name__}\(say=\) is now log="
    with pytest.warns(DeprecationWarning, match=message), pytest.raises((AttributeError, TypeError, ValueError)):
        function(None, None, key=None, say=silent)
