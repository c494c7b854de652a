"""Registry: classes of one kind by name (for example, all policies), from this package and from other packages."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from importlib.metadata import entry_points
from typing import Generic, TypeVar

from imitarm.errors import InputError, UnknownNameError

Item = TypeVar("Item")


class Registry(Mapping[str, Item], Generic[Item]):
    """Classes or objects of one kind, its *members*, by name. A member is imported when it is first used.

    Another package adds a member by an entry point in its ``pyproject.toml``, here a policy with the name ``mine``::

        [project.entry-points."imitarm.policies"]
        mine = "my_package.my_policy:MyPolicy"

    Args:
        kind: what a member is, for messages, for example ``"policy"``.
        group: group of the entry points, for example ``"imitarm.policies"``.
        built_in: for the name of each member of this package, the place ``"module:attribute"`` from which it is
            imported. The registry lists the members in this order.
    """

    def __init__(self, kind: str, group: str, built_in: Mapping[str, str]) -> None:
        self.kind, self.group = kind, group
        self._built_in = dict(built_in)
        self._found: dict[str, str] | None = None
        self._loaded: dict[str, Item] = {}

    def __getitem__(self, name: str) -> Item:
        """Import the member with the name ``name`` if necessary, and return it.

        Raises:
            UnknownNameError: when no member has this name; the message lists all names.
            InputError: when a package that adds the member can't be imported.
        """
        if not isinstance(name, str):
            raise UnknownNameError.among(self.kind, name, self._places())
        if name not in self._loaded:
            places = self._places()
            if name not in places:
                raise UnknownNameError.among(self.kind, name, places)
            self._loaded[name] = self._load(name, places[name])
        return self._loaded[name]

    def register(self, name: str, item: Item) -> None:
        """Add a member until the end of this process, for example in a script.

        Raises:
            InputError: when a built-in member has this name.
        """
        if name in self._built_in:
            raise InputError(f"{self.kind} {name!r} is built in; choose another name")
        self._places()[name] = f"registered {name}"
        self._loaded[name] = item

    def __iter__(self) -> Iterator[str]:
        return iter(self._places())

    def __len__(self) -> int:
        return len(self._places())

    def __contains__(self, name: object) -> bool:
        return name in self._places()

    def _places(self) -> dict[str, str]:
        if self._found is None:
            added = {entry.name: entry.value for entry in entry_points(group=self.group)}
            self._found = {**added, **self._built_in}  # no package replaces a built-in member
            self._found = {name: self._found[name] for name in [*self._built_in, *sorted(added)]}
        return self._found

    def _load(self, name: str, place: str) -> Item:
        module, _, attribute = place.partition(":")
        try:
            return getattr(importlib.import_module(module), attribute)
        except Exception as error:
            if name in self._built_in:
                raise
            raise InputError(
                f"{self.kind} {name!r} is added by the entry point {place!r} ({self.group}), which can't be imported: "
                f"{error}; fix or uninstall that package"
            ) from error
