"""What engines are told is checked by their own tools or schemas, and its commands by our command line.

`stored/compose_spec.json` is the Compose specification's schema as docker-compose 1.29.2 (Apache-2.0) has it.
"""

import json
import re
import shlex
import shutil
import subprocess
from importlib.metadata import version
from pathlib import Path

import pytest
import tyro

from brakeline.deploy.cli import command_class, main
from brakeline.deploy.experiments import task_engine
from brakeline.learner import learner_process

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
yaml = pytest.importorskip("yaml")
BUILT = {"$POD": "router-1", "${POD##*-}": "1", "$number": "7", "${links:+--connect $links}": "--connect tls/a:1"}
UNIT = {"%i": "7", "$ROUTERS": "tls/a:1 tls/b:1", "$LINKS": "", "$ROBOTS": "ground", "$ROBOT": "ground"}


def manifests():
    texts = [path.read_text() for path in sorted((DEPLOY / "kubernetes").glob("*.yaml"))]
    return [part for text in texts for part in yaml.safe_load_all(text)]


def containers(manifest):
    pod = manifest.get("spec", {}).get("template", {}).get("spec", {})
    return [*pod.get("initContainers", ()), *pod.get("containers", ())]


def commands():
    """(where, words) of each `brakeline ...` that an engine starts."""
    for manifest in manifests():
        for container in containers(manifest):
            text = "\n".join(container.get("args", ())).replace("\\\n", " ")
            for name, value in BUILT.items():
                text = text.replace(name, value)
            for line in re.findall(r"exec brakeline (.*)", text):
                yield f"kubernetes {manifest['metadata']['name']}/{container['name']}", shlex.split(line)
    for name, service in yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"].items():
        yield f"compose {name}", shlex.split(service["command"])[1:]
    for path in sorted((DEPLOY / "systemd").glob("*.service")):
        (line,) = re.findall(r"^ExecStart=\S+/brakeline (.*)$", path.read_text(), re.M)
        for name, value in UNIT.items():
            line = line.replace(name, value)
        yield f"systemd {path.name}", shlex.split(line)


@pytest.mark.parametrize(("where", "words"), [pytest.param(*command, id=command[0]) for command in commands()])
def test_each_command_of_an_engine_file_is_parsed(where, words):
    command = tyro.cli(command_class(words[0]), args=words[1:])
    assert command.endpoints.keys is not None
    assert all(endpoint.startswith("tls/") for endpoint in (*command.endpoints.connect, *command.endpoints.listen))


def test_every_engine_starts_every_kind_of_process():
    kinds = {"router", "safety", "learner", "actor", "recorder"}
    for engine in ("kubernetes", "compose", "systemd"):
        assert {words[0] for where, words in commands() if where.startswith(engine)} == kinds


@pytest.mark.parametrize(
    "manifest", [pytest.param(m, id=f"{m['kind']} {m.get('metadata', {}).get('name', '')}") for m in manifests()]
)
def test_kubernetes_manifests_match_the_schema(manifest):
    validate = pytest.importorskip("kubernetes_validate")
    if manifest["kind"] != "Kustomization":
        validate.validate(manifest, validate.latest_version(), strict=True)


def test_kubernetes_manifests_are_consistent():
    by = {(m["kind"], m["metadata"]["name"]): m for m in manifests() if m["kind"] != "Kustomization"}
    for name in ("safety", "actor"):
        target = by["HorizontalPodAutoscaler", name]["spec"]["scaleTargetRef"]
        assert "replicas" not in by[target["kind"], target["name"]]["spec"], "else each `apply` undoes what it did"
    for manifest in by.values():
        for container in containers(manifest):
            probed = [probe for name, probe in container.items() if name.endswith("Probe")]
            assert probed or container["name"] == "models", container["name"]
            ports = {port["name"] for port in container.get("ports", ())}
            assert all(p["httpGet"]["port"] in ports and p["httpGet"]["path"] in ("/live", "/ready") for p in probed)
            volumes = {volume["name"] for volume in manifest["spec"]["template"]["spec"]["volumes"]}
            assert {mount["name"] for mount in container["volumeMounts"]} <= volumes


def test_the_study_on_ray_is_parsed_and_its_pods_match_the_schema():
    validate = pytest.importorskip("kubernetes_validate")
    claim, study = yaml.safe_load_all((DEPLOY / "kubernetes" / "ray" / "study.yaml").read_text())
    validate.validate(claim, validate.latest_version(), strict=True)
    _, name, *words = shlex.split(study["spec"]["entrypoint"])
    assert tyro.cli(command_class(name), args=words).engine.ray == "auto"
    cluster = study["spec"]["rayClusterSpec"]
    assert f"ray=={cluster['rayVersion']}" in (ROOT / "constraints.txt").read_text().splitlines()
    for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
        pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "ray"}, "spec": group["template"]["spec"]}
        validate.validate(pod, validate.latest_version(), strict=True)
        assert all(container["image"] == f"brakeline:{version('brakeline')}" for container in pod["spec"]["containers"])


def test_kustomize_builds_all_manifests():
    if shutil.which("kubectl") is None:
        pytest.skip("no kubectl here")
    done = subprocess.run(["kubectl", "kustomize", DEPLOY / "kubernetes"], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    built = list(yaml.safe_load_all(done.stdout))
    assert len(built) == len(manifests()) - 1
    assert {part["metadata"].get("namespace", "brakeline") for part in built} == {"brakeline"}
    images = {c["image"] for part in built for c in containers(part)}
    assert len(images) == 1 and re.fullmatch(r"brakeline:[\d.]+", images.pop())


def test_compose_file_matches_the_schema():
    jsonschema = pytest.importorskip("jsonschema")
    compose = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    del compose["name"]  # newer than the schema
    schema = json.loads((ROOT / "tests" / "stored" / "compose_spec.json").read_text())
    jsonschema.Draft201909Validator(schema).validate(compose)
    named = {volume.split(":")[0] for s in compose["services"].values() for volume in s["volumes"]}
    assert {name for name in named if not name.startswith(".")} == set(compose["volumes"])


@pytest.mark.parametrize(("done", "status"), [(True, 0), (False, 130)])
def test_a_learner_that_is_stopped_before_its_last_step_has_not_succeeded(monkeypatch, done, status):
    """Before, a drained node ended the Job of a run as if its training were complete."""
    monkeypatch.setattr(learner_process, "learn", lambda _: (done, ""))
    assert main(["learner", "ground", "--listen", "tcp/127.0.0.1:0"]) == status


def test_systemd_verifies_the_units(tmp_path):
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze here")
    units = []
    for path in (DEPLOY / "systemd").glob("*.service"):
        units.append(tmp_path / path.name.replace("@", "@7"))
        units[-1].write_text(path.read_text().replace("/opt/brakeline/.venv/bin/brakeline", "/bin/true"))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *units], check=False, capture_output=True, text=True
    )
    ours = [line for line in done.stderr.splitlines() if "brakeline" in line]
    assert len(units) == 5 and not ours, done.stderr


def test_container_has_every_package():
    lines = (DEPLOY / "Containerfile").read_text().splitlines()
    copied = {word for line in lines if line.startswith("COPY") for word in line.split()[1:-1]}
    assert all((ROOT / name).exists() for name in copied)
    assert {"brakeline", *(link.name for link in (ROOT / "brakeline").iterdir() if link.is_symlink())} <= copied


@pytest.mark.parametrize("workers", [0, -3])
def test_there_is_at_least_one_worker(workers):
    with pytest.raises(ValueError, match=f"--workers is a number from 1 on, not {workers}"):
        task_engine.Engine(workers=workers)
