"""The page of `bokehguide view`: an interactive picture in the browser.

The package is callable: `bokehguide.view(scene)` is `bokehguide.view.notebook.view(scene)`, which shows the page in a notebook.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any


class _CallablePackage(ModuleType):
    """The type of this package."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """See `bokehguide.view.notebook.view`."""
        return import_module("bokehguide.view.notebook").view(*arguments, **options)


sys.modules[__name__].__class__ = _CallablePackage
