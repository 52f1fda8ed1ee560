"""`bokehguide view`."""

from __future__ import annotations

import argparse
import shlex
import webbrowser
from pathlib import Path

from bokehguide.cli.arguments import parse
from bokehguide.cli.memory import describe, explained
from bokehguide.cli.pictures import chosen_exposure
from bokehguide.cli.render import overrides_from, print_warnings
from bokehguide.cli.terminal import clear_stage, say
from bokehguide.errors import BokehguideError
from bokehguide.image.oidn import has_denoiser
from bokehguide.runtime.interrupt import Interrupt
from bokehguide.runtime.process import dedicate_process
from bokehguide.scene import load_scene
from bokehguide.train import RenderSettings
from bokehguide.view.address import is_loopback, require_address
from bokehguide.view.server import ViewServer, require_websockets
from bokehguide.view.session import Exhibit, Session
from bokehguide.view.state import Source, ViewState
from bokehguide.view.watching import WatchedFile

PAGE_OPTIONS = ("command", "started", "watch", "host", "port", "no_browser")
"""Options that have an effect with --watch."""


def run(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C or SIGTERM; returns the exit code."""
    require_websockets()
    refuse_picture(options.scene)
    require_address(options.host, options.port)  # before the scene is loaded, which may take long
    if options.watch:
        refuse_scene_options(options)
        return serve(WatchedFile(options.watch), options)
    dedicate_process()
    RenderSettings(options.mode, spp=options.spp, seed=options.seed)  # checks the values
    scene = load_scene(options.scene, overrides_from(options), options.allow_outside)
    print_warnings(scene)
    with explained(describe(scene)):
        session = make_session(options, Source(scene, overrides_from(options), options.scene, options.allow_outside))
        return serve(session, options)


def refuse_picture(scene: str | None) -> None:
    """Raise BokehguideError for the name of a picture in place of a scene."""
    if scene is not None and Path(scene).suffix.lower() == ".exr":
        remedy = f"bokehguide view --watch {shlex.quote(scene)} shows a picture"
        raise BokehguideError(f"{scene}: is a picture, and no scene; {remedy}")


def refuse_scene_options(options: argparse.Namespace) -> None:
    """Raise BokehguideError for an option of a scene: a watched file has its own picture."""
    defaults = vars(parse(["view", f"--watch={options.watch}"]))
    for name, value in vars(options).items():
        if name not in PAGE_OPTIONS and value != defaults[name]:
            option = f"--{name.replace('_', '-')}"
            raise BokehguideError(f"{option}: has no effect with --watch; leave it out, or give a scene in place of --watch")


def make_session(options: argparse.Namespace, source: Source) -> Session:
    """The session of a scene with the values of the options."""
    denoiser = has_denoiser()
    exposure = chosen_exposure(options.exposure, source.scene.film.exposure)
    denoise = denoiser and not options.noisy
    state = ViewState(source.overrides, options.mode, options.spp, options.seed, exposure, options.view, denoise)
    return Session(source, state, Path.cwd(), denoiser, options.threads)


def serve(shown: Exhibit, options: argparse.Namespace) -> int:
    """Show the page until a signal."""
    server = ViewServer(shown, options.host, options.port)
    with Interrupt() as interrupt:
        server.start()
        clear_stage()
        whom = "this machine alone" if is_loopback(options.host) else "all who know this address, token included"
        print(f"{server.address} serves {whom}; Ctrl-C ends")
        if not options.no_browser:
            webbrowser.open(server.address)
        interrupt.wait()
        server.close()
    say("ended")
    return 0
