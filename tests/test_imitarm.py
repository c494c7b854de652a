"""The public names that are modules and verbs at once."""

from __future__ import annotations

import copy
import importlib
import inspect
import pickle
import subprocess
import sys

import pytest

import imitarm

VERBS = ["reproduce", "retarget"]
CLOUDPICKLE = """
try:
    import cloudpickle
except ModuleNotFoundError:
    from joblib.externals import cloudpickle  # where joblib brings its own
"""


@pytest.mark.parametrize("name", VERBS)
def test_a_verb_is_the_same_after_it_was_pickled_or_copied(name):
    verb = getattr(imitarm, name)
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        assert pickle.loads(pickle.dumps(verb, protocol)) is verb
    assert copy.copy(verb) is verb
    assert copy.deepcopy({"do": verb})["do"] is verb


@pytest.mark.parametrize("line", ["from imitarm import retarget", "import imitarm; retarget = imitarm.retarget"])
@pytest.mark.parametrize("value", ["retarget", "imitarm"])
def test_a_function_of_a_script_that_uses_one_can_be_sent_to_another_process(line, value):
    """As joblib does; the other process has not imported anything of imitarm."""
    script = f"{CLOUDPICKLE}\nimport sys\n{line}\nimport imitarm\ndef job(): return {value}\n"
    script += "sys.stdout.buffer.write(cloudpickle.dumps(job))"
    sent = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True).stdout
    there = "import pickle, sys; it = pickle.load(sys.stdin.buffer)()\n"
    there += "import imitarm; print(it is imitarm or it is imitarm.retarget, callable(imitarm.retarget))"
    done = subprocess.run([sys.executable, "-c", there], input=sent, capture_output=True, check=True)
    assert done.stdout.split() == [b"True", b"True"]


@pytest.mark.parametrize("name", VERBS)
def test_a_verb_shows_the_signature_of_its_function(name):
    verb, function = getattr(imitarm, name), getattr(importlib.import_module(f"imitarm.{name}"), name)
    assert inspect.signature(verb) == inspect.signature(function)
    assert "arguments" not in inspect.signature(verb).parameters
