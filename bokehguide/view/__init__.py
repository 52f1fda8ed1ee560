"""The page of `bokehguide view`: an interactive picture in the browser."""
