"""Names of packages that are imported when they are first used, and packages that are callable."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from types import ModuleType
from typing import Any


def lazy_names(
    package: str, names: Sequence[str], homes: Mapping[str, str], home: str
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package that exports `names`.

    homes: module of a name, relative to the package; home: module of all other names.
    """

    def get(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f"{package}.{homes.get(name, home)}"), name)

    def listed() -> list[str]:
        return sorted({*vars(sys.modules[package]), *names})

    return get, listed


class CallablePackage(ModuleType):
    # A package that is the function of its own name as well. Its docstring, and so `help`, tells the signature of the function.

    _home: str
    """Module of the function."""

    def _function(self) -> Callable[..., Any]:
        """The function. Its module is imported here."""
        return getattr(import_module(self._home), self.__name__.rpartition(".")[2])

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        return self._function()(*arguments, **options)

    @property
    def __signature__(self) -> Any:
        from inspect import signature  # here, as its import takes some milliseconds

        return signature(self._function())

    @property
    def __doc__(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        from inspect import getdoc

        function = self._function()
        return f"{vars(self)['__doc__']}\n{function.__name__}{self.__signature__}\n\n{getdoc(function)}"


def make_callable(package: str, home: str) -> None:
    """Let a call of `package` call the function of the same name in the module `home`, which is imported at the first call."""
    module = sys.modules[package]
    module.__class__ = CallablePackage
    vars(module)["_home"] = home
