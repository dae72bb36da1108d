"""The training loop: exact resumption, schedules, checkpoints, backbones."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from interrupted import trained_twice

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    torch = pytest.importorskip("torch", reason="training needs the extra [train]")
    from torch import Tensor, nn

    from operators.learning.backbone import MobileNetV2, load_backbone, start_from
    from operators.learning.files import TrainingFileError, load_safely, save_atomically
    from operators.learning.loop import Settings, batches, schedule, train


class Line:
    """Fits y = 2x - 1 with a network that also has normalisation statistics and dropout's need of a generator."""

    kind = "line"

    def __init__(self, classes: str = "a") -> None:
        torch.manual_seed(3)
        self.classes = classes
        self._network = nn.Sequential(nn.Linear(1, 8), nn.BatchNorm1d(8), nn.ReLU(), nn.Linear(8, 1))
        self.seen: list[tuple[int, float]] = []

    @property
    def network(self) -> nn.Module:
        return self._network

    @property
    def samples(self) -> int:
        return 20

    def description(self) -> dict[str, Any]:
        return {"classes": self.classes}

    def batch(self, samples: list[int], rngs: list[np.random.Generator]) -> Tensor:
        rows = [[s / 10 - 1, rng.normal(0, 0.01)] for s, rng in zip(samples, rngs, strict=True)]
        self.seen += [(s, r[1]) for s, r in zip(samples, rows, strict=True)]
        return torch.tensor(rows, dtype=torch.float32)

    def loss(self, batch: Tensor, device: torch.device) -> dict[str, Tensor]:
        x, noise = batch[:, :1], batch[:, 1:]
        return {"squares": ((self._network(x) - (2 * x - 1 + noise)) ** 2).mean()}

    def evaluate(self, network: nn.Module) -> dict[str, float]:
        x = torch.linspace(-1, 1, 9)[:, None]
        with torch.inference_mode():
            error = float(((network(x) - (2 * x - 1)) ** 2).mean())
        return {"score": -error, "error": error}

    def export(self, network: nn.Module, facts: Mapping[str, Any], file: Path) -> None:
        file.write_text(f"{facts['epoch']} {facts['scores']['score']}")


def settings(**changes: Any) -> Settings:
    return Settings(**{"epochs": 6, "batch": 6, "learning_rate": 0.02, "threads": 1, "device": "cpu"} | changes)


def weights(file: Path) -> dict[str, Tensor]:
    state = load_safely(file)
    return {f"{part}.{name}": value for part in ("network", "ema") for name, value in state[part].items()}


@pytest.mark.parametrize(
    ("epoch", "step"), [pytest.param(1, 1, marks=pytest.mark.long), (3, 3), pytest.param(5, 2, marks=pytest.mark.long)]
)
def test_a_run_that_was_interrupted_ends_with_the_same_bits(tmp_path: Path, epoch: int, step: int) -> None:
    outcome = trained_twice(Line, settings(), tmp_path, epoch, step)
    whole, halved = weights(tmp_path / "whole.pt"), weights(tmp_path / "halved.pt")
    assert all(torch.equal(whole[name], halved[name]) for name in whole)
    assert [row["epoch"] for row in outcome.history] == [1, 2, 3, 4, 5, 6]


def test_training_is_independent_of_the_number_of_workers(tmp_path: Path) -> None:
    one, many = Line(), Line()
    train(one, settings(), tmp_path / "one.onnx")
    train(many, settings(workers=4), tmp_path / "many.onnx")
    assert sorted(one.seen) == sorted(many.seen)
    a, b = weights(tmp_path / "one.pt"), weights(tmp_path / "many.pt")
    assert all(torch.equal(a[name], b[name]) for name in a)
    for start in range(0, 120, 20):  # every sample once an epoch, varied anew in each
        assert sorted(s for s, _ in one.seen[start : start + 20]) == list(range(20))
    assert len({noise for sample, noise in one.seen if sample == 4}) == 6


def test_a_single_sample_left_over_joins_the_batch_before(tmp_path: Path) -> None:
    assert batches(range(7), 3) == [[0, 1, 2], [3, 4, 5, 6]]
    assert batches(range(8), 3) == [[0, 1, 2], [3, 4, 5], [6, 7]]
    assert batches(range(2), 1) == [[0], [1]]
    assert batches(range(1), 3) == [[0]]

    class Odd(Line):
        samples = 19

    task = Odd()
    train(task, settings(), tmp_path / "odd.onnx")
    assert sorted(s for s, _ in task.seen) == sorted([*range(19)] * settings().epochs)
    with pytest.raises(ValueError, match=r"at least 2 images a step \(now 1\)"):
        train(Odd(), settings(batch=1), tmp_path / "ones.onnx")


def test_the_seed_decides_the_order(tmp_path: Path) -> None:
    orders = []
    for seed in (0, 0, 1):
        task = Line()
        train(task, settings(seed=seed, workers=1), tmp_path / f"{len(orders)}.onnx")
        orders.append(task.seen)
    assert orders[0] == orders[1] != orders[2]


def test_the_file_is_that_of_the_best_epoch(tmp_path: Path) -> None:
    outcome = train(Line(), settings(), tmp_path / "line.onnx")
    best = max(outcome.history, key=lambda row: row["score"])
    assert outcome.best_epoch == best["epoch"]
    assert (tmp_path / "line.onnx").read_text() == f"{outcome.best_epoch} {best['score']}"
    assert outcome.history[-1]["error"] < outcome.history[0]["error"]


def test_a_checkpoint_of_another_training_is_refused_with_the_difference(tmp_path: Path) -> None:
    train(Line(), settings(), tmp_path / "line.onnx")
    with pytest.raises(TrainingFileError, match=r"line\.pt cannot be resumed: its classes is 'a', this run's is 'b'"):
        train(Line("b"), settings(), tmp_path / "line.onnx", resume=True)
    with pytest.raises(TrainingFileError, match=r"epochs was 6 and is 7; to train longer, .*--from .*line\.pt"):
        train(Line(), settings(epochs=7), tmp_path / "line.onnx", resume=True)
    with pytest.raises(FileNotFoundError, match=r"none\.pt"):
        train(Line(), settings(), tmp_path / "none.onnx", resume=True)


def test_a_loss_that_is_not_a_number_ends_training_and_keeps_the_checkpoint(tmp_path: Path) -> None:
    class Diverging(Line):
        def loss(self, batch: Tensor, device: torch.device) -> dict[str, Tensor]:
            parts = super().loss(batch, device)
            return {"squares": parts["squares"] * (float("nan") if len(self.seen) > 45 else 1)}

    with pytest.raises(FloatingPointError, match=r"epoch 3.*lower the learning rate"):
        train(Diverging(), settings(workers=1, batch=20), tmp_path / "line.onnx")
    assert all(torch.isfinite(value).all() for value in weights(tmp_path / "line.pt").values())


def test_the_rate_rises_then_falls_to_almost_nothing() -> None:
    factors = [schedule(step, 100, 0.1) for step in range(100)]
    assert factors[0] == pytest.approx(0.1)
    assert factors[9] == pytest.approx(1)
    assert (np.diff(factors[:10]) > 0).all()
    assert (np.diff(factors[10:]) < 0).all()
    assert factors[-1] < 0.025


# ---- checkpoints


def test_a_failed_write_leaves_the_previous_checkpoint(tmp_path: Path) -> None:
    file = tmp_path / "a.pt"
    save_atomically({"x": torch.ones(2)}, file)
    with pytest.raises((AttributeError, TypeError, Exception)) as error:
        save_atomically({"x": (i for i in range(3))}, file)  # a generator cannot be saved
    assert "pickle" in str(error.value)
    assert load_safely(file)["x"].tolist() == [1, 1]
    assert os.listdir(tmp_path) == ["a.pt"]


def test_a_checkpoint_that_would_run_code_is_refused(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[Any, ...]:
            return os.mkdir, (str(tmp_path / "pwned"),)

    torch.save({"x": Evil()}, tmp_path / "evil.pt")
    with pytest.raises(TrainingFileError, match=r"evil\.pt is no readable checkpoint"):
        load_safely(tmp_path / "evil.pt")
    assert not (tmp_path / "pwned").exists()
    (tmp_path / "text.pt").write_text("hello")
    with pytest.raises(TrainingFileError, match=r"text\.pt"):
        load_safely(tmp_path / "text.pt")


# ---- the backbone


def test_the_maps_have_their_strides_and_channels() -> None:
    network = MobileNetV2(0.5).eval()
    maps = network(torch.zeros(1, 3, 96, 128))
    assert {s: tuple(m.shape[1:]) for s, m in maps.items()} == {
        s: (network.channels[s], 96 // s, 128 // s) for s in (2, 4, 8, 16, 32)
    }
    assert MobileNetV2().channels == {2: 16, 4: 24, 8: 32, 16: 96, 32: 160}  # table 2 of the paper


@pytest.mark.parametrize("old", [False, True])
def test_torchvision_weights_are_taken_by_their_names_of_today_and_of_old(tmp_path: Path, old: bool) -> None:
    torch.manual_seed(0)
    source, network = MobileNetV2(0.25), MobileNetV2(0.25)
    state = {}
    for name, value in source.state_dict().items():
        words = name.split(".")
        if old and len(words) >= 5 and words[2] == "conv":
            first = words[1] == "1"
            nested = words[3:-1]
            flat = {"0.0": "0", "0.1": "1", "1.0": "3", "1.1": "4", "2": "6", "3": "7"}
            if first:
                flat = {"0.0": "0", "0.1": "1", "1": "3", "2": "4"}
            words[3:-1] = [flat[".".join(nested)]]
        state[".".join(words)] = value
    state["classifier.1.weight"] = torch.zeros(1000, 1280)  # what the file has beyond the features is left alone
    torch.save(state, tmp_path / "weights.pt")
    load_backbone(network, tmp_path / "weights.pt")
    x = torch.rand(1, 3, 32, 32)
    for a, b in zip(source.eval()(x).values(), network.eval()(x).values(), strict=True):
        assert torch.equal(a, b)


def test_weights_of_another_width_are_refused_with_both_shapes(tmp_path: Path) -> None:
    torch.save(MobileNetV2(0.5).state_dict(), tmp_path / "half.pt")
    with pytest.raises(TrainingFileError, match=r"must be \(32, 3, 3, 3\) and is \(16, 3, 3, 3\).*same --width"):
        load_backbone(MobileNetV2(1.0), tmp_path / "half.pt")
    with pytest.raises(FileNotFoundError, match="looked for"):
        load_backbone(MobileNetV2(1.0), tmp_path / "none.pt")


def test_frozen_blocks_stay_as_they_are_and_the_others_learn() -> None:
    torch.manual_seed(0)
    network = MobileNetV2(0.25)
    network.freeze(4)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    network.train()
    optimizer = torch.optim.SGD([p for p in network.parameters() if p.requires_grad], 0.1)
    network(torch.rand(2, 3, 64, 64))[32].square().mean().backward()
    optimizer.step()
    changed = {n for n, v in network.state_dict().items() if not torch.equal(v, before[n])}
    assert changed
    assert all(int(name.split(".")[1]) > 3 for name in changed)


def test_fine_tuning_takes_every_weight_that_fits(tmp_path: Path) -> None:
    source, network = (nn.Sequential(nn.Linear(2, 3), nn.Linear(3, k)) for k in (4, 5))
    save_atomically({"ema": source.state_dict()}, tmp_path / "a.pt")
    assert start_from(network, tmp_path / "a.pt") == 2
    assert torch.equal(network[0].weight, source[0].weight)
    save_atomically({"ema": {"other": torch.zeros(1)}}, tmp_path / "b.pt")
    with pytest.raises(TrainingFileError, match="holds no weight of this network"):
        start_from(network, tmp_path / "b.pt")
