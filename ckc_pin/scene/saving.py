"""The files of a scene as texts by name that all lie in one folder."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ckc_pin.base.toml_writer import to_table, write_toml
from ckc_pin.errors import InputError
from ckc_pin.mechanism.files import choose_local_name, local_texts
from ckc_pin.mechanism.library import MECHANISM_FILE
from ckc_pin.scene.arguments import MODEL_FOLDER
from ckc_pin.scene.parts import load_controller_model, load_scene_mechanism

if TYPE_CHECKING:
    from ckc_pin.scene.scene import Scene

__all__ = ["scene_texts"]


def scene_texts(scene: Scene, file: str) -> dict[str, str]:
    """Return the texts of a scene, its mechanism, tables and model by file name, the scene's under the name `file`.

    Raises
    ------
    InputError
        The scene has a controller, an event or a force that is an object of Python, which no file can describe; a file
        that it names is missing.
    """
    objects = [*([scene.controller] if scene.controller is not None else []), *scene.events, *scene.forces]
    if objects:
        what = "event function" if scene.events else "force, a function of the state"
        if scene.controller is not None:
            what = f"controller, {type(objects[0]).__name__}"
        raise InputError(
            f"Scene.save: files cannot describe the scene's {what}, which is an object of Python; give a table, as "
            '{"type": "tracking", ...}, or pass the object to simulate'
        )
    texts = local_texts(load_scene_mechanism(scene))
    data = {**to_table(scene.spec), "mechanism": MECHANISM_FILE}
    controller: dict[str, Any] = data.get("controller", {})
    if "model" in controller:
        model = local_texts(load_controller_model(scene, controller["model"]))
        texts |= {f"{MODEL_FOLDER}{name}": text for name, text in model.items()}
        controller["model"] = f"{MODEL_FOLDER}{MECHANISM_FILE}"
    for table in (controller, controller.get("desired", {}), *data.get("force", [])):
        if isinstance(table.get("file"), str):
            name = choose_local_name(table["file"], texts)
            texts[name] = scene.sources.text(table["file"])
            table["file"] = name
    return {file: write_toml(data), **texts}
