"""MaterialX documents that a stage names, as layers of UsdShade prims.

The package usd-core has no file format for .mtlx. The layers have the structure that the plugin usdMtlx of OpenUSD gives them.
They take the place of the documents in memory, as long as the stage is open.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.parsers import expat

from bokehguide.errors import BokehguideError, printable, reason
from bokehguide.scene.files import SceneFiles
from bokehguide.scene.losses import Losses
from bokehguide.scene.usd.libraries import Ar, Sdf, Tf, Usd, UsdShade
from bokehguide.scene.usd.messages import problem_of

SUFFIX = ".mtlx"
MISSING = "MaterialX documents: left out, as the package MaterialX is missing; run pip install 'bokehguide[usd]'"
GONE = "included MaterialX documents that are missing: left out"
MAX_DEPTH = 100
"""Elements within elements: the reader of MaterialX is recursive."""
MAX_INCLUDES = 16
"""Documents that include each other."""
TYPES = {
    "float": "Float",
    "integer": "Int",
    "boolean": "Bool",
    "string": "String",
    "filename": "Asset",
    "color3": "Color3f",
    "color4": "Color4f",
    "vector2": "Float2",
    "vector3": "Float3",
    "vector4": "Float4",
}
"""Types of USD by those of MaterialX; others become tokens."""
REAL_SIZES = ("realworldimagesize", "realworldtilesize")
"""Inputs with a unit of length. Their ratio counts."""
SHADERS = ("surface", "displacement", "volume")
LINEAR = "lin_rec709"
"""The colour space of a document that names none."""


class Documents:
    """The MaterialX documents of a stage. lost: with the names of documents and nodes."""

    def __init__(self, path: Path, files: SceneFiles):
        self._path, self._files = path, files
        self._layers: dict[str, Any] = {}
        self._replaced: list[tuple[Any, str, str]] = []
        self.lost = Losses()

    def replace(self, layer: Any) -> None:
        """Replace the documents that a layer names.

        Raises BokehguideError for a damaged document, and for one outside the scene's folder.
        """
        for asset in layer.GetCompositionAssetDependencies():
            name = Sdf.Layer.SplitIdentifier(asset)[0]
            resolver = Ar.GetResolver()
            if f".{resolver.GetExtension(name).lower()}" != SUFFIX:
                continue
            absolute = Sdf.ComputeAssetPathRelativeToLayer(layer, name)
            resolved = str(resolver.Resolve(absolute))
            place = f"{self._path}: {printable(name, 200)}"
            self._files.find(self._path.parent, Ar.SplitPackageRelativePathOuter(resolved or absolute)[0], place)
            if resolved and find_spec("MaterialX") is None:
                self.lost.add(MISSING, printable(name, 120))
            elif resolved:
                self._put(layer, asset, self._layer(layer, name, resolved))

    def restore(self) -> None:
        """Put the names of the documents back: USD shares layers in memory."""
        while self._replaced:
            layer, asset, identifier = self._replaced.pop()
            layer.UpdateCompositionAssetDependency(identifier, asset)

    def _put(self, layer: Any, asset: str, replacement: Any) -> None:
        layer.UpdateCompositionAssetDependency(asset, replacement.identifier)
        self._replaced.append((layer, asset, replacement.identifier))

    def _layer(self, layer: Any, name: str, resolved: str) -> Any:
        """The layer of a document."""
        if resolved not in self._layers:
            folder = name.rpartition("/")[0]
            relative = f"{folder}/" if folder.startswith(("/", ".")) else f"./{folder}/" if folder else "./"

            def locate(file: str) -> str:
                return Sdf.ComputeAssetPathRelativeToLayer(layer, f"{relative}{file}")

            document = _Reading(self._path, self._files, self.lost).document(resolved)
            try:
                self._layers[resolved] = _Conversion(document, locate, self.lost).layer
            except (Tf.ErrorException, ValueError) as error:  # values and names that USD does not take
                raise _unreadable(self._path, resolved, problem_of(error, self._path)) from None
        return self._layers[resolved]


class _Reading:
    """The reading of a document and of the documents that it includes. path: of the stage."""

    def __init__(self, path: Path, files: SceneFiles, lost: Losses):
        self._path, self._files, self._lost, self._mx = path, files, lost, import_module("MaterialX")
        self._options = self._mx.XmlReadOptions()
        self._options.readXIncludeFunction = self._include

    def document(self, resolved: str) -> Any:
        """The document at a resolved path. Raises BokehguideError for a damaged one."""
        mx = self._mx
        asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(resolved))
        found = mx.createDocument()
        library = mx.createDocument()
        try:
            mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
            found.setDataLibrary(library)
            folder = mx.FileSearchPath(str(Path(resolved).parent))
            mx.readFromXmlString(found, _checked(bytes(asset.GetBuffer())), folder, self._options)
        except BokehguideError:
            raise
        except Exception as error:  # MaterialX documents no base class of its exceptions
            raise _unreadable(self._path, resolved, reason(error)) from None
        return found

    def _include(self, found: Any, name: Any, folders: Any, options: Any) -> None:
        """Read an included document into `found`. Raises BokehguideError for one outside the scene's folder."""
        if len(options.parentXIncludes) > MAX_INCLUDES:
            raise ValueError(f"more than {MAX_INCLUDES} documents include each other")
        path = self._files.find(Path(folders.asString()), name.asString(), str(self._path))
        if not path.is_file():
            self._lost.add(GONE, printable(name.asString(), 120))
            return
        found.setSourceUri(str(path))
        self._mx.readFromXmlString(found, _checked(path.read_bytes()), self._mx.FileSearchPath(str(path.parent)), options)


def _unreadable(path: Path, resolved: str, problem: str) -> BokehguideError:
    """The error that a document of the stage `path` has a problem."""
    return BokehguideError(f"{path}: {printable(resolved, 200)}: not a readable MaterialX document ({problem}); repair it")


def _checked(data: bytes) -> str:
    """The text of a document. Raises ValueError for too deep elements."""
    depth = 0

    def start(name: str, attributes: Any) -> None:
        nonlocal depth
        depth += 1
        if depth > MAX_DEPTH:
            raise ValueError(f"more than {MAX_DEPTH} elements within each other")

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(data, True)
    return data.decode("utf-8-sig")


class _Conversion:
    """The conversion of a document. locate: the path of a file that the document names."""

    def __init__(self, document: Any, locate: Callable[[str], str], lost: Losses):
        self._document, self._locate, self._lost = document, locate, lost
        self.layer = Sdf.Layer.CreateAnonymous(".usda")
        self._stage = Usd.Stage.Open(self.layer)
        self._waiting: list[tuple[Any, Any]] = []
        self._stage.SetDefaultPrim(self._stage.DefinePrim("/MaterialX"))
        self._stage.DefinePrim("/MaterialX/Materials")
        for node in document.getMaterialNodes():
            self._material(node)

    def _material(self, node: Any) -> None:
        """A material, with all nodes that it depends on."""
        material = UsdShade.Material.Define(self._stage, f"/MaterialX/Materials/{_name(node)}")
        for each in node.getInputs():
            shader, kind = each.getConnectedNode(), each.getName().removesuffix("shader")
            if shader is None or kind not in SHADERS:
                continue
            made = self._shader(material.GetPath(), shader, public=True)
            output = material.CreateOutput(f"mtlx:{kind}", Sdf.ValueTypeNames.Token)
            output.ConnectToSource(made.CreateOutput(kind, Sdf.ValueTypeNames.Token))
        while self._waiting:
            parent, waiting = self._waiting.pop()
            if not self._stage.GetPrimAtPath(parent.AppendChild(_name(waiting))):
                (self._graph if waiting.getCategory() == "nodegraph" else self._shader)(parent, waiting)

    def _shader(self, parent: Any, node: Any, public: bool = False) -> Any:
        """A node. public: constants are inputs of the material, so that stages can change them."""
        shader, definition = UsdShade.Shader.Define(self._stage, parent.AppendChild(_name(node))), node.getNodeDef()
        shader.CreateIdAttr(definition.getName() if definition else f"ND_{node.getCategory()}_{node.getType()}")
        for each in definition.getActiveOutputs() if definition and not public else []:
            shader.CreateOutput(each.getName(), _type(each))
        if public and definition:
            for each in definition.getActiveInputs():
                outer = UsdShade.Material.Get(self._stage, parent).CreateInput(each.getName(), _type(each))
                shader.CreateInput(each.getName(), _type(each)).ConnectToSource(outer)
        for each in node.getInputs():
            given = shader.CreateInput(each.getName(), _type(each))
            connected = self._connect(given, each, parent)
            if not connected and public and definition and definition.getActiveInput(each.getName()):
                given = UsdShade.Material.Get(self._stage, parent).GetInput(each.getName())
            if not connected:
                self._set(given, each)
        return shader

    def _graph(self, parent: Any, node: Any) -> None:
        """A node graph, whose nodes follow."""
        graph = UsdShade.NodeGraph.Define(self._stage, parent.AppendChild(_name(node)))
        for each in node.getInputs():
            given = graph.CreateInput(each.getName(), _type(each))
            if not self._connect(given, each, parent):
                self._set(given, each)
        for each in node.getOutputs():
            self._connect(graph.CreateOutput(each.getName(), _type(each)), each, graph.GetPath())

    def _connect(self, given: Any, element: Any, parent: Any) -> bool:
        """Connect an input or an output as its element is. parent: the prim that holds the sources."""
        output = element.getAttribute("output") or "out"
        if interface := element.getAttribute("interfacename"):
            given.GetAttr().SetConnections([parent.AppendProperty(f"inputs:{interface}")])
            return True
        graph, node = element.getAttribute("nodegraph"), element.getAttribute("nodename")
        if graph:
            source, output = self._document.getNodeGraph(graph), element.getAttribute("output")
            outputs = source.getOutputs() if source else []
            output = output or (outputs[0].getName() if outputs else "out")
        else:
            source = self._sibling(element, node) if node else None
        if source is None:
            if graph or node:
                self._lose("connections of MaterialX nodes to missing nodes: left out", element)
            return False
        self._waiting.append((parent, source))
        given.GetAttr().SetConnections([parent.AppendChild(_name(source)).AppendProperty(f"outputs:{output}")])
        return True

    def _sibling(self, element: Any, name: str) -> Any:
        """The node `name` beside the node of an input, or within the graph of an output."""
        scope = element.getParent()
        while scope is not None and scope.getCategory() != "materialx":
            if scope.getCategory() == "nodegraph" and (found := scope.getNode(name)) is not None:
                return found
            scope = scope.getParent()
        return self._document.getNode(name)

    def _set(self, given: Any, element: Any) -> None:
        """Set an input to the value of its element."""
        kind, attribute = element.getType(), given.GetAttr()
        if not element.getValueString():
            return
        if kind == "filename":
            given.Set(Sdf.AssetPath(self._file(element)))
        elif kind in TYPES:
            given.Set(self._value(element))
        else:
            self._lose(f"MaterialX values of the type {kind}: left out", element)
            return
        if kind in ("filename", "color3", "color4"):
            attribute.SetColorSpace(element.getActiveColorSpace() or LINEAR)

    def _value(self, element: Any) -> Any:
        """The value of an element. Raises ValueError for one that has not its type."""
        value, sized = element.getValue(), element.getName() in REAL_SIZES
        value = value.asTuple() if hasattr(value, "asTuple") else value
        if value is None or (sized and not isinstance(value, tuple)):
            text, path = (printable(each) for each in (element.getValueString(), element.getNamePath()))
            raise ValueError(f"{path}: {text!r} is no value of the type {'vector2' if sized else element.getType()}")
        return tuple(self._scale(element) * part for part in value) if sized else value

    def _file(self, element: Any) -> str:
        """The path of a file. usdMtlx ignores `fileprefix`, so that documents may repeat the prefix in the name."""
        uri = element.getActiveSourceUri()
        names = [element.getResolvedValueString(), element.getValueString()]
        paths = [str(Path(uri).parent / name) if uri or name.startswith("/") else self._locate(name) for name in names]
        existing = [path for path in paths if Ar.GetResolver().Resolve(path.replace("<UDIM>", "1001"))]
        return (existing or paths)[0]

    def _scale(self, element: Any) -> float:
        """The metres of the unit of an element, 1 without a unit."""
        name = element.getAttribute("unit")
        units = {unit.getName(): unit for each in self._document.getUnitDefs() for unit in each.getUnits()}
        return float(units[name].getAttribute("scale")) if name in units else 1.0

    def _lose(self, what: str, element: Any) -> None:
        self._lost.add(what, printable(element.getNamePath(), 120))


def _name(element: Any) -> str:
    return Tf.MakeValidIdentifier(element.getName())


def _type(element: Any) -> Any:
    return getattr(Sdf.ValueTypeNames, TYPES.get(element.getType(), "Token"))
