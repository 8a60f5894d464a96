"""The import rules of the package, as allow-lists: what is not listed here is refused.

`python tests/laws/imports.py` prints every violation, one a line. `make style` runs it.
"""

from __future__ import annotations

import sys

import grimp

# The parts that a part may import, from top to bottom. `part.module` allows that module alone, and what is below it.
PARTS: dict[str, tuple[str, ...]] = {
    "deploy": ("actors", "learner", "logs", "safety", "sim", "messaging", "errors", "extras", "robots", "policies"),
    # An actor knows how to ask the safety service, and what to keep between two queries. The ROS 2 node also turns
    # what a scan does not show to be free into obstacles.
    "actors": (
        *(
            "sim",
            "messaging",
            "errors",
            "safety.filter.backup_plan",
            "safety.filter.request",
            "safety.perception.grid_memory",
            "safety.perception.image_memory",
            "safety.perception.scan_coverage",
            "safety.perception.visibility_memory",
        ),
        *("safety.service.filter_client", "safety.service.client", "safety.service.service_query"),
        "safety.service.wire",
    ),
    "learner": ("messaging", "errors"),
    # The viewers draw the map that the filter was shown. An analysis counts by kind of driving, as statements do.
    "logs": ("messaging", "errors", "safety.perception.displayed_map", "safety.model.driving_kinds"),
    "safety": ("messaging", "errors", "compilation"),
    "sim": ("messaging", "errors", "compilation"),
    "messaging": ("errors", "extras"),
    "errors": ("messaging.brakeline_pb2",),  # for its types alone
    "compilation": (),
    "envs": ("sim.registration",),
    "__main__": ("deploy.cli",),
    "extras": ("errors",),
    "robots": (),
    "policies": (),
}

NUMERICS = ("actors", "deploy", "learner", "logs", "messaging", "safety", "sim")
# The modules that may import an external package. `""` allows all.
PACKAGES: dict[str, tuple[str, ...]] = {
    "numpy": NUMERICS,
    "google": (
        "actors",
        "deploy",
        "logs",
        "messaging",
        "safety.service",
        "safety.perception.displayed_map",
    ),  # protobuf
    "scipy": ("deploy", "logs", "safety.model", "sim"),
    "highspy": ("safety.model.linear_program",),
    "pydantic": ("deploy", "messaging"),
    "safetensors": ("learner", "messaging.policy_weights", "safety.model.tensor_file"),
    "zenoh": ("messaging.bus", "messaging.ros2"),
    "cryptography": ("messaging.bus.certificate_authority", "safety.service.signature"),
    "prometheus_client": ("messaging.metrics_endpoint",),
    "xxhash": ("messaging.ros2",),
    "rosbags": ("messaging.ros2", "logs.bag_writer", "deploy.data.sources.ros_bag"),
    "pymavlink": (
        "actors.mavlink.ardupilot_dialect",
        "sim.autopilot.common_dialect",
        "deploy.data.sources.ardupilot_log",
    ),
    "ray": ("deploy.experiments.ray_tasks",),
    "cma": ("deploy.experiments.worst_case_search",),
    "pyulog": ("deploy.data.sources.px4_log",),
    "pyarrow": ("deploy.data.sources.parquet_files", "deploy.data.sources.csv_file"),
    "numba": ("compilation",),
    "proxsuite": ("safety.filter.qp_solver",),
    "array_api_compat": ("safety.filter.batch",),
    "mujoco": ("sim",),
    "gymnasium": ("safety", "sim", "deploy.data", "deploy.experiments.sac_training", "logs.log_export"),
    "torch": ("learner", "deploy.experiments.sac_training"),
    "stable_baselines3": ("deploy.experiments.sac_training",),
    "mcap": ("logs",),
    "mcap_protobuf": ("logs",),
    "lz4": ("logs", "deploy.data.sources.bag_storage"),
    "zstandard": ("logs", "deploy.data.sources.bag_storage"),
    "foxglove": ("logs.watch",),
    "foxglove_schemas_protobuf": ("logs.foxglove_scene",),
    "jinja2": ("logs.report_page",),
    "minari": ("logs.log_export",),
    "matplotlib": ("deploy", "logs", "sim"),
    "imageio_ffmpeg": ("deploy.run.episode_render",),
    "rich": ("deploy", "logs"),
    "tyro": ("deploy",),
    "docstring_parser": ("deploy",),
    "filelock": ("deploy.data",),
}


def within(module: str, allowed: tuple[str, ...]) -> bool:
    """Return whether a module is one of the allowed ones, or lies below one."""
    return any(module == name or module.startswith(name + ".") for name in allowed)


def violations() -> list[str]:
    """Return a line for every import of `brakeline`, as it is found on the path, that no list allows."""
    graph = grimp.build_graph("brakeline", include_external_packages=True, cache_dir=None)
    lines = []
    for importer in sorted(graph.modules):
        if not importer.startswith("brakeline."):
            continue  # the package itself names the public names of all parts
        source = importer.removeprefix("brakeline.")
        part = source.partition(".")[0]
        for imported in sorted(graph.find_modules_directly_imported_by(importer)):
            target = imported.removeprefix("brakeline.")
            if imported == "brakeline":
                lines.append(f"{source} imports the public names: import the module that defines them")
            elif imported.startswith("brakeline."):
                if target.partition(".")[0] != part and not within(target, PARTS.get(part, ())):
                    lines.append(f"{source} imports {target}, which {part} may not")
            elif imported not in sys.stdlib_module_names and not within(source, PACKAGES.get(imported, ())):
                lines.append(f"{source} imports {imported}, which only {PACKAGES.get(imported, ('nothing',))} may")
    return lines


if __name__ == "__main__":
    found = violations()
    print("\n".join(found) or "imports: every import is allowed")
    sys.exit(bool(found))
