"""`rgbd-calib schema`: the JSON Schemas of the files, from the same models that the readers use."""

from __future__ import annotations

import click

from rgbd_calib.cli.options import show
from rgbd_calib.errors import ConfigError

MODELS = {
    "dataset": ("rgbd_calib.io.dataset", "DatasetModel", "dataset.yaml of a recording"),
    "rig": ("rgbd_calib.io.schemas", "RigModel", "rig.yaml, intrinsics.yaml, depth_bias.yaml, truth.yaml"),
    "config": ("rgbd_calib.pipeline.config", "Config", "the file of --config"),
}
"""Module and type (anything that pydantic knows) of each file format, and the files it describes."""


@click.command
@click.argument("name", required=False, metavar="[NAME]")
def command(name: str | None) -> None:
    """Print the JSON Schema of a file format.

    Without NAME, list the formats. Editors that know JSON Schema then complete and check the YAML while it is typed.

    \b
    Examples:
      rgbd-calib schema
      rgbd-calib schema dataset > dataset.schema.json
    """
    from importlib import import_module
    from importlib.util import find_spec

    from pydantic import TypeAdapter

    from rgbd_calib.io.plain import to_json

    models = {key: value for key, value in MODELS.items() if find_spec(value[0])}
    if name is None:
        for key, (_, _, files) in models.items():
            show(f"{key:10}{files}")
        return
    if name not in models:
        raise ConfigError(f"schema: '{name}' seen, one of {', '.join(models)} needed")
    module, model, files = models[name]
    schema = TypeAdapter(getattr(import_module(module), model)).json_schema()
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema"} | schema | {"title": files}
    show(to_json(schema, indent=2))
