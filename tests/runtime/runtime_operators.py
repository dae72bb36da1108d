"""Small operators for tests of the runtime: cheap, with every kind of input, and some that misbehave."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from dataflow.messages import FeatureVector, Image, Message, Point
from dataflow.operator import Batch, In, Operator, Out, Param, Sampled, Source


def value(stamp: int, *numbers: float) -> FeatureVector:
    """A message that holds a few numbers."""
    return FeatureVector(stamp=stamp, vectors=np.array([numbers], np.float32).reshape(1, -1), model="test")


def number(message: FeatureVector) -> float:
    return float(message.vectors[0, 0])


def nap(seconds: float) -> None:
    """Sleeps for a random time up to `seconds`: shakes the order of arrival, never a result."""
    if seconds > 0:
        time.sleep(int.from_bytes(os.urandom(2)) / 65535 * seconds)


def daemon() -> None:
    """Leaves a process in a session of its own, whose parent ends at once; it keeps everything open that this has."""
    child = os.fork()
    if child:
        os.waitpid(child, 0)
        return
    os.setsid()
    if grandchild := os.fork():
        print(f"left behind: {grandchild}", flush=True)
        os._exit(0)
    time.sleep(300)
    os._exit(0)


class Counter(Source):
    """Counts on `fast`; every `ratio`-th step also on `slow`. `padding` numbers make the messages large."""

    fast: Out[FeatureVector]
    slow: Out[FeatureVector]
    constant: Out[FeatureVector] = Out(static=True)
    count: int = Param(100, ge=0, doc="how many steps")
    period: int = Param(10_000_000, gt=0, doc="step, ns")
    ratio: int = Param(5, gt=0, doc="steps to a message on slow")
    jitter: int = Param(0, ge=0, doc="stamps move by up to so many ns, in a fixed pattern")
    padding: int = Param(0, ge=0, doc="numbers that follow the first")
    sleep: float = Param(0.0, ge=0, doc="longest random sleep before a step, s")

    def static_outputs(self) -> Mapping[str, Message]:
        return {"constant": value(0, 42.0)}

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(self.count):
            nap(self.sleep)
            stamp = 1_000_000_000 + k * self.period + (k * 7919 % (self.jitter + 1))
            step = {"fast": value(stamp, k, *range(self.padding))}
            if k % self.ratio == 0:
                step["slow"] = value(stamp, -k)
            yield step

    def length(self) -> int:
        return self.count


class Corner(Operator):
    """Emits a pixel as a point, with and without stamp and frame."""

    image: In[Image]
    told: Out[Point]
    left_out: Out[Point]

    def process(self, image: Image) -> Mapping[str, Message]:
        position = [float(image.data[0, 0].sum()), 0, 0]
        return {
            "told": Point(stamp=image.stamp, frame=image.frame, position=position),
            "left_out": Point(position=position),
        }


class Mix(Operator, tolerance="3ms"):
    """Joins two streams by nearest stamp, samples the last feedback, batches a third stream, draws random numbers."""

    a: In[FeatureVector]
    b: In[FeatureVector]
    constant: Sampled[FeatureVector]
    feedback: Sampled[FeatureVector] = Sampled(before=True, required=False)
    recent: Batch[FeatureVector]
    mixed: Out[FeatureVector]
    sleep: float = Param(0.0, ge=0, doc="longest random sleep in a firing, s")

    def process(
        self,
        a: FeatureVector,
        b: FeatureVector,
        constant: FeatureVector,
        feedback: FeatureVector | None,
        recent: tuple[FeatureVector, ...],
    ) -> FeatureVector:
        nap(self.sleep)
        return value(
            a.stamp,
            number(a) + 2 * number(b) + number(constant),
            0.0 if feedback is None else number(feedback),
            sum(number(m) for m in recent),
            len(recent),
            self.rng.normal(),
            np.random.random(),
        )


class Smooth(Operator, every="25ms"):
    """A running mean, on every message and on a timer: it has state, and sometimes emits nothing."""

    x: In[FeatureVector]
    mean: Out[FeatureVector]
    sleep: float = Param(0.0, ge=0, doc="longest random sleep in a firing, s")

    def setup(self) -> None:
        self.state, self.calls = 0.0, 0

    def process(self, x: FeatureVector | None, context) -> FeatureVector | None:
        nap(self.sleep)
        self.calls += 1
        if x is not None:
            self.state = 0.9 * self.state + 0.1 * number(x)
        if self.calls % 7 == 3:
            return None
        return value(context.stamp, self.state, self.calls, float(context.tick))

    def finish(self) -> FeatureVector:
        return value(10**15, self.state)


class Merge(Operator, merge=True):
    """Every message of every stream it can get, in stamp order."""

    all: In[FeatureVector] = In(many=True)
    seen: Out[FeatureVector]

    def setup(self) -> None:
        self.total = 0.0

    def process(self, all: Mapping[str, FeatureVector]) -> FeatureVector:
        self.total += sum(number(m) * (k + 1) for k, m in enumerate(all.values()))
        return value(max(m.stamp for m in all.values()), self.total, len(all))


class Sum(Operator):
    """A sink that reports what it saw; the first message makes the file `seen`."""

    x: In[FeatureVector]
    seen: str | None = Param(None, doc="none: no file")

    def setup(self) -> None:
        self.count, self.total = 0, 0.0

    def process(self, x: FeatureVector) -> None:
        if not self.count and self.seen is not None:
            Path(self.seen).touch()
        self.count += 1
        self.total += number(x)

    def summary(self) -> Mapping[str, float]:
        return {"count": self.count, "total": self.total}


class Act(Sum):
    """A sink that acts on the world."""

    external = True


class Broken(Operator):
    """Fails at one message, in one of several ways."""

    x: In[FeatureVector]
    y: Out[FeatureVector]
    at: int = Param(20, doc="the number at which it fails")
    how: str = Param("raise", doc="raise, die, crash, hang, stamp, type, mutate, chatter, exit, children or daemon")

    def process(self, x: FeatureVector) -> FeatureVector:
        if number(x) == self.at:
            match self.how:
                case "raise":
                    raise RuntimeError("the gripper is on fire")
                case "die":
                    os.kill(os.getpid(), signal.SIGKILL)
                case "crash":
                    ctypes.string_at(0)
                case "hang":
                    time.sleep(3600)
                case "stamp":
                    return value(x.stamp - 1, 0.0)
                case "type":
                    return "nothing"
                case "mutate":
                    x.vectors.flags.writeable = True
                    x.vectors[0, 0] += 1
                case "chatter":
                    print("still here", flush=True)
                case "exit":
                    raise SystemExit("enough")
                case "children":
                    left = subprocess.Popen(["sleep", "300"])
                    print(f"left behind: {left.pid}", flush=True)
                case "daemon":
                    daemon()
        return value(x.stamp, number(x))


class LookAhead(Operator, tolerance="100s"):
    """A join that cannot decide before it has seen very far ahead."""

    a: In[FeatureVector]
    b: In[FeatureVector]
    y: Out[FeatureVector]

    def process(self, a: FeatureVector, b: FeatureVector) -> FeatureVector:
        return value(a.stamp, number(b))


class SmoothChanged(Smooth):
    """`Smooth` after somebody changed its arithmetic, in a way that shows late and only here."""

    def process(self, x: FeatureVector | None, context) -> FeatureVector | None:
        made = super().process(x, context)
        if made is not None and self.calls > 40:
            made = value(made.stamp, number(made) + 1e-3)
        return made


class Unrepeatable(Operator):
    """Reads the clock from its thirtieth call on."""

    x: In[FeatureVector]
    y: Out[FeatureVector]

    def setup(self) -> None:
        self.calls = 0

    def process(self, x: FeatureVector) -> FeatureVector:
        self.calls += 1
        return value(x.stamp, number(x) + (time.time() % 1 if self.calls >= 30 else 0.0))


class Tuned(Operator):
    """Adds up, with a factor that may change while it runs."""

    x: In[FeatureVector]
    y: Out[FeatureVector]
    factor: float = Param(1.0, ge=0, le=10, tunable=True, doc="weight of what comes")

    def setup(self) -> None:
        self.total = 0.0

    def process(self, x: FeatureVector) -> FeatureVector:
        self.total += self.factor * number(x)
        return value(x.stamp, self.total)

    def snapshot(self) -> Mapping[str, float]:
        return {"total": self.total}

    def restore(self, state: Mapping[str, float]) -> None:
        self.total = state["total"]


class TunedByConstant(Tuned):
    """Weighs by a static message, too."""

    constant: Sampled[FeatureVector]

    def process(self, x: FeatureVector, constant: FeatureVector) -> FeatureVector:
        made = super().process(x)
        return value(made.stamp, number(made) * number(constant))


class TunedAtStart(Tuned):
    """Keeps the factor with which it was started."""

    def setup(self) -> None:
        super().setup()
        self.began_with = self.factor

    def process(self, x: FeatureVector) -> FeatureVector:
        made = super().process(x)
        return value(made.stamp, number(made) + self.began_with)


class TunedNudged(Tuned):
    """`Tuned` as another machine's rounding might leave it."""

    def setup(self) -> None:
        self.total = 1e-4


class TunedForgetful(Tuned):
    """`Tuned` whose `restore` loses something."""

    def restore(self, state: Mapping[str, float]) -> None:
        self.total = state["total"] + 1


class Tidy(Source):
    """Goes on for ever, and releases its device at the end."""

    y: Out[FeatureVector]
    note: str = Param(doc="file to write at the end")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        try:
            for k in range(10**9):
                time.sleep(0.005)
                yield {"y": value(1_000_000_000 + k * 5_000_000, k)}
        finally:
            Path(self.note).write_text("device released")
