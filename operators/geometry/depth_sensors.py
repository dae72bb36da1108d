"""Reads how noisy depth cameras are, by their names in depth_sensors.yaml or from a given file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

FILE = Path(__file__).with_name("depth_sensors.yaml")
DEPTH_SENSOR = "camera whose noise is taken: a name of operators/geometry/depth_sensors.yaml, or an own YAML file"

_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class DepthSensor(BaseModel):
    """Standard deviation of a depth: floor (m) + quadratic (1/m) · z²; quadratic follows from a stereo's geometry."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    floor: _Positive
    quadratic: _Positive
    range: tuple[_Positive, _Positive] | None = None
    source: str = ""

    @model_validator(mode="before")
    @classmethod
    def _of_stereo(cls, given: Any) -> Any:
        """Returns an entry with subpixel / (focal · baseline) in their place."""
        stereo = {"baseline", "focal", "subpixel"}
        if not isinstance(given, dict) or not stereo & given.keys():
            return given
        if "quadratic" in given or not stereo <= given.keys():
            raise ValueError("give quadratic, or all of baseline, focal and subpixel")
        baseline, focal, subpixel = (float(given[name]) for name in ("baseline", "focal", "subpixel"))
        if min(baseline, focal, subpixel) <= 0:
            raise ValueError("baseline, focal and subpixel must be greater than 0")
        return {k: v for k, v in given.items() if k not in stereo} | {"quadratic": subpixel / (focal * baseline)}


def read_depth_sensor(given: str, use_file: Callable[[Path], Path] = Path) -> DepthSensor | None:
    """Returns a sensor by its name, or from a YAML file with one entry's keys; none for "".

    Raises FileNotFoundError, and ValueError for an unknown name, which lists the known ones, or a bad file.
    """
    if not given:
        return None
    own = given.endswith((".yaml", ".yml"))
    file = use_file(Path(given) if own else FILE)
    try:
        content = YAML(typ="safe").load(file.read_text(encoding="utf-8"))
        if not own and given not in content:
            raise ValueError(f"no depth sensor {given!r}: it may be {', '.join(content)}, or a YAML file ({FILE.name})")
        return DepthSensor.model_validate(content if own else content[given])
    except (YAMLError, UnicodeDecodeError, ValidationError) as error:
        raise ValueError(f"{file} describes no depth sensor as {FILE.name} does: {error}") from None
