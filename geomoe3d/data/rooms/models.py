"""Furniture from model folders: Sweet Home 3D libraries and plain folders of OBJ or GLB files.

A library (``*.sh3f``, or the same unpacked) has a catalogue that gives each model's kind and real size in
centimetres; its models have y up and any unit, so each is brought to its catalogue size. Models without a
catalogue are taken as metres if their size is believable for furniture, else they are scaled to a height
of their kind, which is read from the file's name. A model that cannot be read is named once and passed over.
"""

from __future__ import annotations

import io
import re
import zipfile
from collections import OrderedDict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.data.rooms.pieces import Piece, Shelf
from geomoe3d.data.rooms.solids import Solids
from geomoe3d.errors import InputError

MODEL_SUFFIXES = (".obj", ".glb", ".gltf", ".ply", ".stl", ".off")
_CATALOGUE = "PluginFurnitureCatalog.properties"

# Kind of piece -> words of a model's name or tags. The first that fits decides.
_WORDS: dict[str, tuple[str, ...]] = {
    "office chair": ("office chair", "swivel", "desk chair", "armchair office"),
    "washbasin": ("washbasin", "wash basin", "sink", "basin"),
    "bathtub": ("bathtub", "bath tub", "tub", "shower"),
    "toilet": ("toilet", "wc", "bidet"),
    "coffee table": ("coffee table", "low table"),
    "sofa": ("sofa", "couch", "armchair", "loveseat"),
    "bed": ("bed", "crib", "bunk"),
    "chair": ("chair", "stool", "bench", "seat"),
    "desk": ("desk", "workstation", "workplace"),
    "table": ("table",),
    "wardrobe": ("wardrobe", "closet", "armoire", "cupboard"),
    "bookshelf": ("bookcase", "bookshelf", "shelf", "shelves", "library", "rack"),
    "chest": (
        "chest",
        "drawer",
        "cabinet",
        "sideboard",
        "dresser",
        "commode",
        "nightstand",
        "bedside",
        "buffet",
    ),
    "fridge": ("fridge", "refrigerator", "washer", "washing", "oven", "cooker", "dishwasher", "freezer"),
    "lamp": ("floor lamp", "floor uplight", "lamp", "light"),
    "plant": ("plant", "tree", "flower", "cactus"),
    "picture": ("picture", "frame", "mirror", "poster", "tv", "screen"),
    "radiator": ("radiator", "heater"),
    "boxes": (
        "box",
        "bin",
        "basket",
        "suitcase",
        "piano",
        "guitar",
        "bicycle",
        "bike",
        "fireplace",
        "speaker",
    ),
}
# Metres: most extent along the wall, into the room, upwards.
_LARGEST = (3.5, 2.6, 2.6)


@dataclass(frozen=True)
class Model:
    """One model file and its real size (width, depth, height) in metres, None where it is not given."""

    kind: str
    name: str
    archive: Path | None
    path: str
    size: tuple[float, float, float] | None


@dataclass
class ModelLibrary:
    """Models of one or more folders by kind; loads them when they are drawn and keeps the last ones.

    Attributes:
        folders: where they come from.
        models: kind of piece -> models.
        unreadable: one sentence per file that could not be listed, and per attempt to draw one that could
            not be loaded.
    """

    folders: list[Path]
    models: dict[str, list[Model]] = field(default_factory=dict)
    unreadable: list[str] = field(default_factory=list)
    _cache: OrderedDict[str, Piece | str] = field(default_factory=OrderedDict, repr=False)

    def __len__(self) -> int:
        return sum(len(models) for models in self.models.values())

    def draw(self, kind: str, rng: np.random.Generator) -> Piece | None:
        """A piece of a kind, or None where there is no readable one after a few tries."""
        models = self.models.get(kind, [])
        for _ in range(3 if models else 0):
            piece = self._load(models[int(rng.integers(len(models)))])
            if piece is not None:
                return piece
        return None

    def _load(self, model: Model) -> Piece | None:
        key = f"{model.archive}:{model.path}"
        if key not in self._cache:
            try:
                self._cache[key] = _read_piece(model)
            except Exception as error:  # loaders of five formats raise nearly anything
                self._cache[key] = f"{model.name} ({model.path}): {type(error).__name__}: {error}"
            if len(self._cache) > 64:  # models are large
                self._cache.popitem(last=False)
        self._cache.move_to_end(key)
        found = self._cache[key]
        if isinstance(found, Piece):
            return found
        self.unreadable.append(found)
        return None


def open_library(folders: list[str | Path]) -> ModelLibrary:
    """List the models of folders; nothing is loaded yet. Raises InputError: a folder is missing, or none of
    them holds a model whose kind is known."""
    library = ModelLibrary([Path(folder) for folder in folders])
    for folder in library.folders:
        if not folder.is_dir():
            raise InputError(f"model folder '{folder}' is not a folder")
        for archive in sorted(folder.rglob("*.sh3f")):
            _list_archive(library, archive)
        catalogues = sorted(folder.rglob(_CATALOGUE))
        for catalogue in catalogues:
            _list_catalogue(library, catalogue.read_text("latin1"), None, catalogue.parent)
        covered = [catalogue.parent for catalogue in catalogues]
        for path in sorted(p for p in folder.rglob("*") if p.suffix.lower() in MODEL_SUFFIXES):
            if not any(parent in path.parents for parent in covered):
                _add(library, Model("", path.stem, None, str(path), None), f"{path.parent.name} {path.stem}")
    if not len(library):
        raise InputError(
            f"no usable model in {', '.join(map(str, library.folders))}: looked for *.sh3f, {_CATALOGUE} and "
            f"{', '.join(MODEL_SUFFIXES)} files named like furniture"
        )
    return library


def _list_archive(library: ModelLibrary, archive: Path) -> None:
    try:
        with zipfile.ZipFile(archive) as content:
            text = content.read(_CATALOGUE).decode("latin1")
    except (OSError, KeyError, zipfile.BadZipFile) as error:
        library.unreadable.append(f"{archive.name}: no furniture library: {error}")
        return
    _list_catalogue(library, text, archive, Path())


def _list_catalogue(library: ModelLibrary, text: str, archive: Path | None, folder: Path) -> None:
    entries: dict[int, dict[str, str]] = {}
    for match in re.finditer(r"^(\w+)#(\d+)\s*=\s*(.*?)\s*$", text, re.MULTILINE):
        entries.setdefault(int(match[2]), {})[match[1]] = match[3]
    for number, entry in sorted(entries.items()):
        if entry.get("category") in ("Characters", "Exterior", "Vehicles", "Staircases", "Doors and windows"):
            continue
        try:
            width, depth, height = (float(entry[key]) / 100 for key in ("width", "depth", "height"))
            inside = entry["model"].lstrip("/")
        except (KeyError, ValueError):
            library.unreadable.append(f"catalogue entry {number}: no model or size")
            continue
        path = inside if archive is not None else str(folder / inside)
        model = Model("", entry.get("name", inside), archive, path, (width, depth, height))
        _add(library, model, f"{entry.get('name', '')} {inside}")


def _add(library: ModelLibrary, model: Model, described: str) -> None:
    text = re.sub(r"[^a-z]+", " ", described.lower())
    for kind, words in _WORDS.items():
        if any(re.search(rf"\b{word}s?\b", text) for word in words):
            if model.size is None or all(a <= b for a, b in zip(model.size, _LARGEST, strict=True)):
                known = Model(kind, model.name, model.archive, model.path, model.size)
                library.models.setdefault(kind, []).append(known)
            return


def _read_piece(model: Model) -> Piece:
    vertices, faces = _read_triangles(model)
    most = 60_000
    if len(faces) > most:
        raise InputError(f"{len(faces)} triangles, at most {most} are used")
    vertices = vertices[:, [0, 2, 1]] * (-1.0, 1.0, 1.0)  # y up to z up; the front, their +z, to our +y
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    extent = high - low
    if not (np.isfinite(extent).all() and extent.max() > 0):
        raise InputError(f"extent {extent.tolist()}")
    if model.size is not None:
        scale = np.asarray(model.size) / np.maximum(extent, 1e-6)
    elif 0.2 < extent.max() < 3.5 and (extent <= _LARGEST).all():
        scale = np.ones(3)
    else:
        usual = {"chair": 0.9, "table": 0.75, "desk": 0.75, "sofa": 0.8, "bed": 0.6, "wardrobe": 2.0}
        scale = np.full(3, usual.get(model.kind, 1.0) / max(extent[2], 1e-6))
    size = extent * scale
    if (size > np.asarray(_LARGEST) + 1e-6).any():
        raise InputError(f"{size.round(2).tolist()} m are too large for furniture")
    local = (vertices - low) * scale - (size[0] / 2, 0.0, 0.0)
    solids = Solids()
    solids.triangles(local, faces)
    half, depth, top = float(size[0]) / 2, float(size[1]), float(size[2])
    shelves = []
    if model.kind in ("table", "desk", "coffee table", "chest") and top < 1.3:
        shelves = [Shelf((-half * 0.8, half * 0.8), (0.1 * depth, 0.9 * depth), top)]
    return Piece(model.kind, solids, 2 * half, depth, top, shelves, hangs=model.kind == "picture")


def _read_triangles(model: Model) -> tuple[Any, Any]:
    import trimesh

    kind = Path(model.path).suffix.lower().lstrip(".")
    if model.archive is None:
        if Path(model.path).stat().st_size == 0:
            raise InputError("the file is empty")
        loaded: Any = trimesh.load(model.path, force="mesh", process=False, skip_materials=True)
    else:
        with zipfile.ZipFile(model.archive) as content:
            data = io.BytesIO(content.read(model.path))
        loaded = trimesh.load(data, file_type=kind, force="mesh", process=False, skip_materials=True)
    vertices = np.asarray(getattr(loaded, "vertices", np.zeros((0, 3))), dtype=np.float64)
    faces = np.asarray(getattr(loaded, "faces", np.zeros((0, 3))), dtype=np.int64)
    if not len(faces) or not len(vertices):
        raise InputError("the file holds no triangles")
    return vertices, faces
