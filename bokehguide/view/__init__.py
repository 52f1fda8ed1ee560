"""The page of `bokehguide view`: an interactive picture in the browser.

The package is callable: `bokehguide.view(scene)` is `bokehguide.view.notebook.view(scene)`, which shows the page in a notebook.
"""

from bokehguide.lazy_names import make_callable

make_callable(__name__, "bokehguide.view.notebook")
