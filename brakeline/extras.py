"""The optional parts of an installation: which extra brings a package that is missing."""

from __future__ import annotations

from brakeline.errors import MissingExtra

# pyproject.toml lists the same packages under [project.optional-dependencies].
EXTRAS: dict[str, tuple[str, ...]] = {
    "sim": ("cma", "imageio_ffmpeg", "matplotlib", "mujoco"),
    "train": ("torch",),
    "mavlink": ("pymavlink", "pyulog"),
    "ros2": ("rosbags", "xxhash"),
    "logs": (
        *("foxglove", "foxglove_schemas_protobuf", "jinja2", "lz4", "matplotlib", "mcap", "mcap_protobuf", "minari"),
        *("pyarrow", "zstandard"),
    ),
    "ray": ("ray",),
    "rivals": ("stable_baselines3",),
}


def missing_extra(error: ModuleNotFoundError) -> MissingExtra | None:
    """Return the error that names the extra to install, or None if no extra brings the missing package.

    >>> str(missing_extra(ModuleNotFoundError("No module named 'torch'", name="torch")))
    "torch is not installed. It comes with the extra `train`: pip install 'brakeline[train]'"
    """
    package = (error.name or "").partition(".")[0]
    extras = [extra for extra, packages in EXTRAS.items() if package in packages]
    if not extras:
        return None
    which = " or ".join(f"`{extra}`" for extra in extras)
    return MissingExtra(
        f"{package} is not installed. It comes with the extra {which}: pip install 'brakeline[{extras[0]}]'",
        name=package,
    )
