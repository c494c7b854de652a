from __future__ import annotations

import subprocess

import pytest

from imitarm.benchmark.provenance import code_version, origin, version_of

NEVER = "version 0"


def git(folder, *words):
    author = ["-c", "user.name=n", "-c", "user.email=e@example.org", "-c", "commit.gpgsign=false"]
    subprocess.run(["git", *author, "-C", folder, *words], check=True, capture_output=True)


@pytest.fixture
def checkout(tmp_path):
    """A package in a repository with one commit."""
    package = tmp_path / "src" / "package"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("a = 1\n")
    (tmp_path / "README.md").write_text("read me\n")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "first")
    return package


def test_a_commit_names_the_code_until_a_commit_changes_the_package(checkout):
    first = version_of(checkout, NEVER)
    assert first.startswith("commit ") and "uncommitted" not in first
    (checkout.parents[1] / "README.md").write_text("read me again\n")
    assert version_of(checkout, NEVER) == first
    git(checkout, "commit", "-qam", "documentation")
    assert version_of(checkout, NEVER) == first
    (checkout / "__init__.py").write_text("a = 2\n")
    git(checkout, "commit", "-qam", "code")
    assert version_of(checkout, NEVER) not in {first, NEVER}


def test_two_states_of_a_working_tree_have_two_names(checkout):
    clean, names = version_of(checkout, NEVER), set()
    for name, text in (("__init__.py", "a = 3\n"), ("__init__.py", "a = 4\n"), ("new.py", "x"), ("new.py", "y")):
        (checkout / name).write_text(text)
        names.add(version_of(checkout, NEVER))
    assert len(names) == 4
    assert all(name.startswith(f"{clean} with uncommitted changes ") for name in names)
    (checkout / "new.py").unlink()
    git(checkout, "checkout", "-q", ".")
    assert version_of(checkout, NEVER) == clean


def test_what_is_not_in_a_checkout_is_named_by_its_version(checkout, tmp_path_factory):
    installed = checkout / "environment" / "package"  # inside a repository that knows nothing of it
    installed.mkdir(parents=True)
    (installed / "__init__.py").write_text("")
    assert version_of(installed, NEVER) == NEVER
    assert version_of(tmp_path_factory.mktemp("nowhere"), NEVER) == NEVER


def test_a_page_says_when_its_results_are_of_other_code():
    assert origin([code_version()] * 2) == f"Results of {code_version()}."
    mixed = origin([code_version(), "commit 0123456789"])
    assert "commit 0123456789" in mixed and "Run the command again" in mixed
