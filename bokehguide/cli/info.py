"""`bokehguide info`."""

from __future__ import annotations

import argparse

from bokehguide.cli.folders import make_folders, print_folders
from bokehguide.cli.inputs import refuse_scene_files
from bokehguide.cli.render import check_device, overrides_from, settings_from
from bokehguide.cli.report import json_file, text_beside, write_json
from bokehguide.image import check_writable
from bokehguide.runtime.process import dedicate_process
from bokehguide.scene import load_scene, summarize
from bokehguide.scene.emitters import find_emitters
from bokehguide.scene.inspection import as_json, inspect


def run(options: argparse.Namespace) -> int:
    """Print a scene as `render` with the same options sees it, and write the files that are asked for."""
    dedicate_process()
    scene = load_scene(options.scene, overrides_from(options), options.allow_outside)
    settings = settings_from(options, scene)
    settings.window(scene.film.width, scene.film.height)
    check_device(settings.device)
    refuse_scene_files(scene, [("--json", json_file(options.json)), ("--picture", options.picture)])
    outputs = [path for path in (json_file(options.json), options.picture) if path is not None]
    print_folders(make_folders([path.parent for path in outputs]))
    for path in outputs:
        check_writable(path)
    facts = inspect(scene, find_emitters(scene))
    if options.picture:
        from bokehguide.cli.focus_view import write_focus_view  # imports the renderer, which the facts do not need

        write_focus_view(options.picture, scene, facts)
    if options.json:
        write_json(options.json, as_json(scene, facts))
    with text_beside(options.json):
        print(summarize(scene, facts))  # after the files, as the reader may close the pipe
        if options.picture:
            print(f"wrote {options.picture}")
    return 0
