"""`schema`: what is printed is a valid JSON Schema and accepts what the writers write."""

import json

import jsonschema
import pytest
import yaml

from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.io.recording import CameraInfo, write_dataset
from rgbd_calib.types import Board


def test_without_a_name_the_formats_are_listed(run):
    outcome = run("schema")
    assert outcome.status == 0
    assert [line.split()[0] for line in outcome.stdout.splitlines()][:2] == ["dataset", "rig"]


def test_every_schema_listed_is_valid(run):
    for line in run("schema").stdout.splitlines():
        outcome = run("schema", line.split()[0])
        assert outcome.status == 0
        jsonschema.Draft202012Validator.check_schema(json.loads(outcome.stdout))


def test_dataset_schema_accepts_what_is_written_and_refuses_a_wrong_type(run, tmp_path):
    schema = json.loads(run("schema", "dataset").stdout)
    info = CameraInfo(640, 480, serial="1404", intrinsics=Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0))
    write_dataset(tmp_path, {"C1": info}, Board(9, 6, 0.06, two_sided=True, thickness_m=0.006))
    data = yaml.safe_load((tmp_path / "dataset.yaml").read_text())
    jsonschema.validate(data, schema)
    data["cameras"]["C1"]["width"] = "wide"
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(data, schema)


def test_an_unknown_name_is_an_error_that_lists_the_names(run):
    outcome = run("schema", "rigg")
    assert outcome.status == 2
    assert "one of dataset, rig" in outcome.stderr
