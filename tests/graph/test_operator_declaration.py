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


FAULTY = """\
class X(Operator): image: int = In(); PROCESS
  X.image: is a In port and must be annotated In[...]
class X(Operator): image = In(); PROCESS
  X.image: is a port without a type: write `image: In[Image]`
class X(Operator): image: In[Image]; gain = Param(1, doc='g'); PROCESS
  X.gain: is a parameter without a type
class X(Operator): image: In[int]; PROCESS
  X.image: needs a message type: In[Image]
class X(Operator): image: In[Nothing]; PROCESS
  X.(annotations): name 'Nothing' is not defined; types of ports and of the state must be known
class X(Operator): image: In[Image] = Out(); PROCESS
  X.image: is annotated In[...] but set to a Out
class X(Operator): context: In[Image]; PROCESS
  X.context: is a name that Operator uses; choose another for the port
class X(Operator): image: In[Image]; setup: int = Param(1, doc='r'); PROCESS
  choose another for the parameter
class X(Operator): a: Out[Image]; def process(self): ...
  X.(inputs): nothing makes it fire
class X(Operator, every='0s'): image: In[Image]; PROCESS
  X.every: must be positive, got '0s'
class X(Operator, merge=True, tolerance='1ms'): image: In[Image]; PROCESS
  X.tolerance: has no meaning with merge=True
class X(Operator): image: In[Image] = In(many=True); other: In[Image]; PROCESS
  X.image: many=True on one of several joined inputs
class X(Operator): image: In[Image]
  X.process: is missing: define process(self, image)
class X(Operator): image: In[Image]; def process(self, imge): ...
  takes 'imge', which is no input
class X(Operator): image: In[Image]; def process(self): ...
  does not take the input 'image'
class X(Operator): image: In[Image]; def process(self, **all): ...
  instead of *all
class X(Operator): image: In[Image]; out: Out[Pose]; def process(self, image) -> Image | None: ...
  X.process: returns Image, but out emits Pose
class X(Operator): image: In[Image]; def process(self, image) -> Image: ...
  X.process: returns one message, but has 0 outputs (none): return a mapping
class X(Operator): image: In[Image]; out: Out[Pose]; def process(self, image) -> Found | None: ...
  X.process: returns 'pose', which is no output; outputs: out
class X(Operator): image: In[Image]; pose: Out[Image]; def process(self, image) -> Found: ...
  X.process: returns Pose, but pose emits Image
class X(Operator): image: In[Image]; out: Out[Pose]; PROCESS; def finish(self) -> Image: ...
  X.finish: returns Image, but out emits Pose
class X(Source): image: In[Image]; out: Out[Image]
  X.image: a source has no inputs
class X(Source): gain: int = Param(1, doc='g')
  X.(outputs): a source needs at least one Out[...]
"""
"""Statements of a class, of which PROCESS is a method that takes the image; what is said about it."""


@pytest.mark.parametrize(("head", "body", "said"), re.findall(r"class X\((.*?)\): (.*)\n  (.*)\n", FAULTY))
def test_a_faulty_declaration_names_the_attribute(head: str, body: str, said: str) -> None:
    lines = body.replace("PROCESS", "def process(self, image): ...").split("; ")
    with pytest.raises(OperatorDefinitionError) as caught:
        exec("\n    ".join([f"class X({head}):", *lines]), dict(NAMES))

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
