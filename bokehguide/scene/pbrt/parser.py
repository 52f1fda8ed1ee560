"""Directives of pbrt files, and the graphics state that they change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from bokehguide.errors import printable
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.pbrt.contents import Contents, Instance, Light, Shape, State, Texture
from bokehguide.scene.pbrt.parameters import Parameters, read_parameters
from bokehguide.scene.pbrt.spectra import COLOR_SPACES
from bokehguide.scene.pbrt.tokens import MOST_TEXT, Place, Tokens, read_source
from bokehguide.scene.pbrt.transform_directives import TRANSFORMS, TransformDirective
from bokehguide.scene.pbrt.transforms import inverse
from bokehguide.scene.tables import did_you_mean

MAX_DEPTH = 16
"""Files that include each other; a cycle has more."""
MAX_FILES = 10_000
"""Inclusions of a scene."""
MAX_STATES = 1000
"""Nested AttributeBegin."""
OLDER_OPTIONS = ("SurfaceIntegrator", "VolumeIntegrator", "Renderer")
"""Directives of pbrt-v2 and older before WorldBegin."""
TARGETS = ("shape", "light", "material", "medium", "texture")


def parse(path: Path, files: SceneFiles) -> Contents:
    """The entries of a file and its includes. Raises BokehguideError, naming file and line, for a malformed file."""
    parser = _Parser(path, files)
    parser.read(path, "", 0)
    parser.finish()
    return parser.contents


class _Parser:
    """Applies directives to the graphics state, and collects entries."""

    def __init__(self, path: Path, files: SceneFiles):
        self.contents, self._folder, self._files = Contents(), path.parent, files
        self._state = State()
        self._stack: list[tuple[str, Place, State]] = []
        self._systems: dict[str, np.ndarray] = {}
        self._object: str | None = None
        self._objects: dict[str, str] = {}
        self._ended = False
        self._world, self._included, self._text, self._depth = False, 0, 0, 0

    def read(self, path: Path, place: str, depth: int) -> None:
        """Apply the directives of a file. place: where it is named."""
        source = read_source(path, self._files, place)
        self._text += len(source.text)
        tokens = Tokens(source)
        if depth > MAX_DEPTH:
            tokens.place.fail(f"files include each other more than {MAX_DEPTH} deep; break the cycle")
        if self._included > MAX_FILES or self._text > MOST_TEXT:
            tokens.place.fail(f"the scene includes more than {MAX_FILES:,} files, or {MOST_TEXT:,} characters; include fewer")
        while tokens.next is not None and not self._ended:
            at = tokens.place
            word = tokens.take("a directive")
            self._depth = depth
            apply = DIRECTIVES.get(word)
            if apply is None:
                at.fail(f"{printable(word)!r} is no directive of pbrt; {did_you_mean(word, DIRECTIVES)}")
            apply(self, tokens, at)

    def finish(self) -> None:
        """Raise BokehguideError for a block without an end."""
        if self._stack:
            begin, place, _ = self._stack[-1]
            place.fail(f"{begin}Begin without {begin}End; add the end")

    def transform(self, tokens: Tokens, at: Place, change: TransformDirective) -> None:
        self._state = change(self._state, tokens, at)

    def coordinate_system(self, tokens: Tokens, at: Place) -> None:
        self._systems[tokens.text("a name")] = self._state.matrix

    def coord_sys_transform(self, tokens: Tokens, at: Place) -> None:
        name = tokens.text("a name")
        if name not in self._systems:
            at.fail(f"CoordSysTransform {printable(name)!r}: no such coordinate system; {did_you_mean(name, self._systems)}")
        self._state = replace(self._state, matrix=self._systems[name])

    def active_transform(self, tokens: Tokens, at: Place) -> None:
        word = tokens.take("StartTime, EndTime or All")
        if word not in ("StartTime", "EndTime", "All"):
            at.fail(f"ActiveTransform {printable(word)}; give StartTime, EndTime or All")
        self._state = replace(self._state, active=word != "EndTime")
        if word == "EndTime":
            self.contents.lose("motion: the start of the exposure counts", str(at))

    def begin(self, kind: str, at: Place) -> None:
        if len(self._stack) >= MAX_STATES:
            at.fail(f"more than {MAX_STATES} nested {kind}Begin; end some of them")
        self._stack.append((kind, at, self._state))

    def end(self, kind: str, at: Place) -> None:
        """Restore the state of the last begin. Before pbrt-v4, blocks may overlap, and TransformEnd restores the transform."""
        if not self._stack or (self._stack[-1][0] != kind and not self.contents.older):
            at.fail(f"{kind}End without its {kind}Begin; remove one or add the other")
        before, inside = self._stack.pop()[2], self._state
        only_transform = kind == "Transform" and self.contents.older
        self._state = replace(inside, matrix=before.matrix, active=before.active) if only_transform else before

    def object_begin(self, tokens: Tokens, at: Place) -> None:
        name = tokens.text("the name of an object")
        if self._object is not None:
            at.fail("ObjectBegin within another object; end the first one before")
        if name in self.contents.objects and not self.contents.older:
            at.fail(f"ObjectBegin {printable(name)!r}: an object of this name exists; give another name")
        self.begin("Object", at)
        # Before pbrt-v4, another object of the same name replaces the first one for the instances that follow.
        key = name if name not in self.contents.objects else f"{name} {len(self.contents.objects)}"
        self._object, self._objects[name], self.contents.objects[key] = key, key, []

    def object_end(self, tokens: Tokens, at: Place) -> None:
        self.end("Object", at)
        self._object = None

    def object_instance(self, tokens: Tokens, at: Place) -> None:
        name = tokens.text("the name of an object")
        if self._object is not None:
            at.fail("ObjectInstance within an object; write it outside of ObjectBegin and ObjectEnd")
        self.contents.instances.append(Instance(self._objects.get(name, name), self._state.matrix, at))
        if len(self.contents.instances) > self._files.most_instances:
            at.fail(f"more than {self._files.most_instances:,} instances for files as small as these; give fewer")

    def include(self, tokens: Tokens, at: Place, own_state: bool) -> None:
        name, depth = tokens.text("a file name"), self._depth
        self._included += 1
        before = self._state
        path = self._files.find(self._folder, name, str(at))
        self.read(path, str(at), depth + 1)
        self._depth = depth
        self._state = before if own_state else self._state

    def color_space(self, tokens: Tokens, at: Place) -> None:
        name = tokens.text("a colour space").lower()
        if name not in COLOR_SPACES:
            at.fail(f"ColorSpace {printable(name)!r}: unknown; {did_you_mean(name, COLOR_SPACES)}")
        self._state = replace(self._state, space=name)

    def attribute(self, tokens: Tokens, at: Place) -> None:
        read = self._parameters(tokens, at)
        if read.kind not in TARGETS:
            at.fail(f"Attribute {printable(read.kind)!r}: unknown target; {did_you_mean(read.kind, TARGETS)}")
        changed = self._state.attributes.get(read.kind, {}) | read.values
        self._state = replace(self._state, attributes=self._state.attributes | {read.kind: changed})

    def _parameters(self, tokens: Tokens, at: Place, target: str = "") -> Parameters:
        kind = tokens.text("a name")
        return read_parameters(tokens, kind, at, self._state.attributes.get(target, {}).items(), self._state.space)

    def option(self, tokens: Tokens, at: Place, directive: str) -> None:
        """A directive before WorldBegin."""
        read = self._parameters(tokens, at)
        if directive == "Camera":
            self.contents.camera, self.contents.camera_matrix = read, self._state.matrix
            self._systems["camera"] = inverse(self._state.matrix, at, "the camera")
        elif directive == "Film":
            self.contents.film = read
            self.contents.older |= read.kind == "image"
        elif directive in ("Integrator", "SurfaceIntegrator"):
            self.contents.integrator = read

    def world_begin(self, tokens: Tokens, at: Place) -> None:
        if self._world:
            at.fail("a second WorldBegin; remove it")
        self._world = True
        self._state = replace(self._state, matrix=np.eye(4), active=True)
        self._systems["world"] = np.eye(4)

    def world_end(self, tokens: Tokens, at: Place) -> None:
        """The end of a scene of pbrt-v3 and older, which another scene may follow."""
        self.contents.older = self._ended = True
        if tokens.next is not None:
            self.contents.lose("scenes after the first WorldEnd: left out", at.short)

    def volume(self, tokens: Tokens, at: Place) -> None:
        """A medium of pbrt-v2 and older."""
        self.contents.lose("media: left out", printable(self._parameters(tokens, at).kind))

    def material(self, tokens: Tokens, at: Place) -> None:
        self._state = replace(self._state, material=self._parameters(tokens, at, "material"))

    def make_named_material(self, tokens: Tokens, at: Place) -> None:
        read = self._parameters(tokens, at, "material")
        if "type" not in read:
            at.fail(f'MakeNamedMaterial {printable(read.kind)!r} without a type; give one, as in "string type" "diffuse"')
        self.contents.materials[read.kind] = replace(read, kind=read.text("type"))

    def named_material(self, tokens: Tokens, at: Place) -> None:
        name = tokens.text("the name of a material")
        if self.contents.older and name not in self.contents.materials:
            self.contents.lose(
                "unknown names of materials: the material before stays, as in pbrt-v3", f"{printable(name)}, {at.short}"
            )
            return
        self._state = replace(self._state, material=name)

    def texture(self, tokens: Tokens, at: Place) -> None:
        name, value = tokens.text("a name"), tokens.text("float or spectrum")
        value = "spectrum" if value == "color" else value
        if value not in ("float", "spectrum"):
            at.fail(f"Texture {printable(name)!r} is of the type {printable(value)!r}; give float or spectrum")
        self.contents.textures[value, name] = Texture(value, self._parameters(tokens, at, "texture"))

    def light_source(self, tokens: Tokens, at: Place) -> None:
        self.contents.lights.append(Light(self._parameters(tokens, at, "light"), self._state.matrix))

    def area_light(self, tokens: Tokens, at: Place) -> None:
        self._state = replace(self._state, light=self._parameters(tokens, at, "light"))

    def shape(self, tokens: Tokens, at: Place) -> None:
        state = self._state
        read = self._parameters(tokens, at, "shape")
        if not self._world:
            at.fail("Shape before WorldBegin; write WorldBegin above it")
        shapes = self.contents.shapes if self._object is None else self.contents.objects[self._object]
        shapes.append(Shape(read, state.matrix, state.reverse, state.material, state.light))

    def reverse_orientation(self, tokens: Tokens, at: Place) -> None:
        self._state = replace(self._state, reverse=not self._state.reverse)

    def medium(self, tokens: Tokens, at: Place) -> None:
        names = [tokens.text("a name")]
        while tokens.next is not None and tokens.next[0] == '"' and len(names) < 2:
            names.append(tokens.text("a name"))
        if any(names):
            self.contents.lose("media: left out", next(printable(name) for name in names if name))

    def named_medium(self, tokens: Tokens, at: Place) -> None:
        self._parameters(tokens, at)

    def quiet_option(self, tokens: Tokens, at: Place) -> None:
        tokens.text("a name")
        tokens.take("a value")

    def times(self, tokens: Tokens, at: Place) -> None:
        tokens.numbers(2, "TransformTimes")


Directive = Callable[[_Parser, Tokens, Place], None]
DIRECTIVES: dict[str, Directive] = {
    "CoordinateSystem": _Parser.coordinate_system,
    "CoordSysTransform": _Parser.coord_sys_transform,
    "ActiveTransform": _Parser.active_transform,
    "TransformTimes": _Parser.times,
    "AttributeBegin": lambda parser, tokens, at: parser.begin("Attribute", at),
    "AttributeEnd": lambda parser, tokens, at: parser.end("Attribute", at),
    "TransformBegin": lambda parser, tokens, at: parser.begin("Transform", at),
    "TransformEnd": lambda parser, tokens, at: parser.end("Transform", at),
    "Attribute": _Parser.attribute,
    "ObjectBegin": _Parser.object_begin,
    "ObjectEnd": _Parser.object_end,
    "ObjectInstance": _Parser.object_instance,
    "Include": lambda parser, tokens, at: parser.include(tokens, at, False),
    "Import": lambda parser, tokens, at: parser.include(tokens, at, True),
    "ColorSpace": _Parser.color_space,
    "Option": _Parser.quiet_option,
    "WorldBegin": _Parser.world_begin,
    "WorldEnd": _Parser.world_end,
    "Volume": _Parser.volume,
    "Material": _Parser.material,
    "MakeNamedMaterial": _Parser.make_named_material,
    "NamedMaterial": _Parser.named_material,
    "Texture": _Parser.texture,
    "LightSource": _Parser.light_source,
    "AreaLightSource": _Parser.area_light,
    "Shape": _Parser.shape,
    "ReverseOrientation": _Parser.reverse_orientation,
    "MediumInterface": _Parser.medium,
    "MakeNamedMedium": _Parser.named_medium,
}
DIRECTIVES |= {
    name: lambda parser, tokens, at, change=change: parser.transform(tokens, at, change) for name, change in TRANSFORMS.items()
}
DIRECTIVES |= {
    name: lambda parser, tokens, at, name=name: parser.option(tokens, at, name)
    for name in ("Camera", "Film", "Integrator", "Sampler", "PixelFilter", "Accelerator", *OLDER_OPTIONS)
}
