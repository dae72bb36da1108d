"""A mistake in the declaration of an operator is an error when its class is made, and names the attribute."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import TypedDict

import pytest

from dataflow.messages import Image, PointCloud, Pose
from dataflow.operator import Batch, In, Operator, OperatorDefinitionError, Out, Param, Sampled, Source


class Found(TypedDict, total=False):
    pose: Pose | None


NAMES = {
    **{cls.__name__: cls for cls in (Batch, In, Operator, Out, Sampled, Source, Image, PointCloud, Pose)},
    "Found": Found,
    "Param": Param,
    "__name__": __name__,
}

GOOD = """\
class Good(Operator, merge=True, every="100ms"):
    '''Does good.'''
    image: In[Image] = In(many=True, doc="pictures")
    pose: Sampled[Pose] = Sampled(required=False, before="50ms")
    clouds: Batch[PointCloud | Pose] = Batch(max=3)
    found: Out[Pose] = Out(lag="1s")
    gain: float = Param(0.5, ge=0, doc="gain", tunable=True)

    def process(self, image, pose, clouds, context):
        return None
"""


def test_port_types_of_a_source_may_be_names_of_the_function_that_makes_it() -> None:
    names = dict(NAMES)
    exec("def make():\n    Local = Image\n    class X(Source):\n        image: 'Out[Local]'\n    return X", names)
    assert names["make"]().spec.outputs["image"].types == (Image,)


def test_a_declaration_is_read_whole() -> None:
    names = dict(NAMES)
    exec(GOOD, names)
    spec = names["Good"].spec

    assert (spec.name, spec.doc, spec.merge, spec.every) == ("Good", "Does good.", True, 100_000_000)
    assert {name: port.kind for name, port in spec.inputs.items()} == {
        "image": "in",
        "pose": "sampled",
        "clouds": "batch",
    }
    assert spec.inputs["clouds"].types == (PointCloud, Pose)
    assert (spec.inputs["pose"].before, spec.outputs["found"].lag) == (50_000_000, 1_000_000_000)
    assert list(spec.parameters.model_fields) == ["gain"]
    assert spec.process_takes == ("image", "pose", "clouds", "context")


P = "\n    def process(self, image):\n        return None\n"


@pytest.mark.parametrize(
    ("head", "body", "said"),
    [
        ("Operator", "    image: int = In()" + P, "X.image: is a In port and must be annotated In[...]"),
        ("Operator", "    image = In()" + P, "X.image: is a port without a type: write `image: In[Image]`"),
        ("Operator", "    image: In[Image]\n    gain = Param(1, doc='g')" + P, "X.gain: is a parameter without a type"),
        ("Operator", "    image: In[int]" + P, "X.image: needs a message type: In[Image]"),
        ("Operator", "    image: In[Nothing]" + P, "X.(annotations): name 'Nothing' is not defined"),
        ("Operator", "    image: In[Image] = Out()" + P, "X.image: is annotated In[...] but set to a Out"),
        (
            "Operator",
            "    context: In[Image]" + P,
            "X.context: is a name that Operator uses; choose another for the port",
        ),
        (
            "Operator",
            "    image: In[Image]\n    setup: int = Param(1, doc='r')" + P,
            "choose another for the parameter",
        ),
        (
            "Operator",
            "    a: Out[Image]\n    def process(self):\n        return None\n",
            "X.(inputs): nothing makes it fire",
        ),
        ("Operator, every='0s'", "    image: In[Image]" + P, "X.every: must be positive, got '0s'"),
        (
            "Operator, merge=True, tolerance='1ms'",
            "    image: In[Image]" + P,
            "X.tolerance: has no meaning with merge=True",
        ),
        (
            "Operator",
            "    image: In[Image] = In(many=True)\n    other: In[Image]" + P,
            "X.image: many=True on one of several joined inputs",
        ),
        ("Operator", "    image: In[Image]\n", "X.process: is missing: define process(self, image)"),
        (
            "Operator",
            "    image: In[Image]\n    def process(self, imge):\n        pass\n",
            "takes 'imge', which is no input",
        ),
        ("Operator", "    image: In[Image]\n    def process(self):\n        pass\n", "does not take the input 'image'"),
        ("Operator", "    image: In[Image]\n    def process(self, **all):\n        pass\n", "instead of *all"),
        (
            "Operator",
            "    image: In[Image]\n    out: Out[Pose]\n    def process(self, image) -> Image | None:\n        pass\n",
            "X.process: returns Image, but out emits Pose",
        ),
        (
            "Operator",
            "    image: In[Image]\n    def process(self, image) -> Image:\n        pass\n",
            "X.process: returns one message, but has 0 outputs (none): return a mapping",
        ),
        (
            "Operator",
            "    image: In[Image]\n    out: Out[Pose]\n    def process(self, image) -> Found | None:\n        pass\n",
            "X.process: returns 'pose', which is no output; outputs: out",
        ),
        (
            "Operator",
            "    image: In[Image]\n    pose: Out[Image]\n    def process(self, image) -> Found:\n        pass\n",
            "X.process: returns Pose, but pose emits Image",
        ),
        (
            "Operator",
            "    image: In[Image]\n    out: Out[Pose]" + P + "    def finish(self) -> Image:\n        pass\n",
            "X.finish: returns Image, but out emits Pose",
        ),
        ("Source", "    image: In[Image]\n    out: Out[Image]\n", "X.image: a source has no inputs"),
        ("Source", "    gain: int = Param(1, doc='g')\n", "X.(outputs): a source needs at least one Out[...]"),
    ],
)
def test_a_faulty_declaration_names_the_attribute(head: str, body: str, said: str) -> None:
    code = f"class X({head}):\n{body}"
    with pytest.raises(OperatorDefinitionError) as caught:
        exec(code, dict(NAMES))

    assert said in str(caught.value)


def test_wrong_returns_are_left_to_the_type_checker_of_the_project(repository: Path) -> None:
    """It reports each ignored mistake of the file that it does not find."""
    settings = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["mypy"]
    assert settings["strict"]
    assert "tests/support/typed_returns.py" in settings["files"]
    text = (repository / "tests/support/typed_returns.py").read_text(encoding="utf-8")
    assert len(re.findall(r"# type: ignore\[[\w-]+\]$", text, re.MULTILINE)) == 5


def test_a_subclass_inherits_ports_and_timing_and_adds_its_own() -> None:
    names = dict(NAMES)
    exec(GOOD + "\nclass Better(Good):\n    best: Out[Image]\n", names)

    assert names["Better"].spec.every == 100_000_000
    assert list(names["Better"].spec.outputs) == ["found", "best"]
