"""Draws the pictures of docs/design.md and docs/concepts.md as SVG: `python docs/images/draw.py`.

The pictures of time and of arrival are computed: the aligner that ships decides what they show.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from xml.sax.saxutils import escape

from dataflow.sync import Aligner, AlignSpec, BatchSpec, Entry, Firing, SampledSpec, TriggerSpec

HERE = Path(__file__).parent
MS = 1_000_000
INK, FAINT, BLUE, GREEN, ORANGE, RED, VIOLET = (
    "#1f2430",
    "#98a1b3",
    "#2f6fde",
    "#1c8c5a",
    "#c46a13",
    "#c2303a",
    "#7a4fc9",
)


class Drawing:
    """Collects the elements of one SVG picture."""

    def __init__(self, width: int, height: int) -> None:
        self._size = (width, height)
        self._items: list[str] = []

    def line(
        self,
        x1: float,
        y1: float,
        x2: float,
        y2: float,
        color: str = INK,
        *,
        width: float = 1.5,
        arrow: bool = False,
        dashes: str = "",
    ) -> None:
        end = ' marker-end="url(#arrow)"' if arrow else ""
        dash = f' stroke-dasharray="{dashes}"' if dashes else ""
        self._items.append(
            f'<line x1="{x1:g}" y1="{y1:g}" x2="{x2:g}" y2="{y2:g}" stroke="{color}" stroke-width="{width:g}"'
            f"{end}{dash}/>"
        )

    def dot(self, x: float, y: float, color: str, *, filled: bool = True, radius: float = 6) -> None:
        fill = color if filled else "#ffffff"
        self._items.append(
            f'<circle cx="{x:g}" cy="{y:g}" r="{radius:g}" fill="{fill}" stroke="{color}" stroke-width="2"/>'
        )

    def box(
        self, x: float, y: float, w: float, h: float, color: str, *, fill: str = "#ffffff", dashes: str = ""
    ) -> None:
        dash = f' stroke-dasharray="{dashes}"' if dashes else ""
        self._items.append(
            f'<rect x="{x:g}" y="{y:g}" width="{w:g}" height="{h:g}" rx="6" fill="{fill}" stroke="{color}" '
            f'stroke-width="1.5"{dash}/>'
        )

    def text(self, x: float, y: float, words: str, color: str = INK, *, size: int = 14, anchor: str = "start") -> None:
        """Writes words above a white edge. The edge is a second text: not every program supports `paint-order`."""
        start = f'<text x="{x:g}" y="{y:g}" font-size="{size}" text-anchor="{anchor}"'
        edge = 'fill="none" stroke="#ffffff" stroke-width="4" stroke-linejoin="round" aria-hidden="true"'
        self._items.append(f"{start} {edge}>{escape(words)}</text>")
        self._items.append(f'{start} fill="{color}">{escape(words)}</text>')

    def svg(self) -> str:
        width, height = self._size
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" '
            'font-family="Helvetica, Arial, sans-serif">\n'
            '<defs><marker id="arrow" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" '
            f'orient="auto-start-reverse"><path d="M0 0 L10 5 L0 10 z" fill="{INK}"/></marker></defs>\n'
            f'<rect width="{width}" height="{height}" fill="#ffffff"/>\n'
        )
        return head + "\n".join(self._items) + "\n</svg>\n"


# Time

STREAMS: Mapping[str, tuple[int, ...]] = {
    "color": (10, 43, 76, 110, 143),
    "depth": (13, 46, 113, 146),
    "pose": (5, 55, 105, 152),
    "imu": tuple(range(0, 150, 10)),
}
SPEC = AlignSpec(
    triggers=(TriggerSpec("color", ("color",)), TriggerSpec("depth", ("depth",))),
    sampled=(SampledSpec("pose", ("pose",)),),
    batches=(BatchSpec("imu", ("imu",)),),
    tolerance=10 * MS,
)


def decide() -> tuple[list[Firing], list[tuple[str, int]]]:
    """The firings of `SPEC` for `STREAMS`, and the messages dropped: (stream, ms)."""
    aligner = Aligner(SPEC)
    firings: list[Firing] = []
    for stream, stamps in STREAMS.items():
        for seq, stamp in enumerate(stamps):
            aligner.push(stream, Entry(stamp * MS, seq=seq))
    while (firing := aligner.poll()) is not None:
        firings.append(firing)
    return firings, [(d.stream, d.stamp // MS) for d in aligner.take_drops()]


def entries_of(firing: Firing) -> Iterable[tuple[str, int]]:
    for value in firing.inputs.values():
        for entry in value if isinstance(value, tuple) else (value,):
            if isinstance(entry, Entry):
                yield entry.stream, entry.stamp // MS


def time() -> str:
    firings, dropped = decide()
    drawing = Drawing(1000, 470)
    rows = {"color": 70, "depth": 130, "pose": 190, "imu": 250}
    colors = {"color": BLUE, "depth": BLUE, "pose": GREEN, "imu": ORANGE}
    notes = {
        "color": "In: triggers, the anchor of the join",
        "depth": "In, tolerance 10 ms",
        "pose": "Sampled: the newest at or before",
        "imu": "Batch: all since the last firing",
    }

    def x(ms: float) -> float:
        return 270 + ms * 4.6

    drawing.text(20, 30, "One operator, four inputs: event time decides what each firing is given", size=17)
    for firing in firings:
        at = firing.stamp / MS
        drawing.line(x(at), 55, x(at), 330, FAINT, width=1, dashes="4 4")
        for stream, stamp in entries_of(firing):
            drawing.line(x(stamp), rows[stream], x(at), 330, colors[stream], width=1)
    for stream, y in rows.items():
        drawing.text(20, y - 2, stream, colors[stream], size=16)
        drawing.text(20, y + 16, notes[stream], FAINT, size=12)
        drawing.line(x(-3), y, x(155), y, FAINT, width=1)
        for stamp in STREAMS[stream]:
            lost = (stream, stamp) in dropped
            drawing.dot(
                x(stamp), y, RED if lost else colors[stream], filled=not lost, radius=4 if stream == "imu" else 6
            )
            if lost:
                drawing.text(x(stamp), y - 12, "unmatched: dropped, counted", RED, size=12, anchor="middle")
        last = STREAMS[stream][-1]
        drawing.line(x(last), y - 10, x(last), y + 10, VIOLET, width=3)
    drawing.text(20, 336, "firings", size=16)
    for firing in firings:
        at = firing.stamp / MS
        drawing.box(x(at) - 40, 330, 80, 30, INK, fill="#eef2fb")
        drawing.text(x(at), 350, f"t = {at:g} ms", size=12, anchor="middle")
        drawing.text(
            x(at), 378, f"{sum(s == 'imu' for s, _ in entries_of(firing))} imu", ORANGE, size=12, anchor="middle"
        )
    drawing.line(x(-3), 410, x(155), 410, arrow=True)
    drawing.text(x(155), 430, "event time (timestamps of messages)", size=12, anchor="end")
    drawing.line(30, 448, 30, 462, VIOLET, width=3)
    legend = "frontier (watermark): no later message has a timestamp at or before it."
    legend += " 143 ms is undecided until imu's reaches it."
    drawing.text(42, 460, legend, VIOLET, size=13)
    return drawing.svg()


# Arrival

ORDERS: Mapping[str, tuple[tuple[str, int], ...]] = {
    "as taken": (("image", 10), ("pose", 5), ("pose", 18), ("image", 20), ("pose", 28), ("image", 30), ("pose", 35)),
    "images late": (("pose", 5), ("pose", 18), ("pose", 28), ("pose", 35), ("image", 10), ("image", 20), ("image", 30)),
    "poses late": (("image", 10), ("image", 20), ("image", 30), ("pose", 5), ("pose", 18), ("pose", 28), ("pose", 35)),
}
"""The same messages (stream, ms) in three orders of arrival."""


def decided(order: Iterable[tuple[str, int]]) -> list[tuple[int, Firing]]:
    """The firings of an operator with images and a sampled pose, each with the number of the arrival that decides."""
    aligner = Aligner(
        AlignSpec(triggers=(TriggerSpec("image", ("image",)),), sampled=(SampledSpec("pose", ("pose",)),))
    )
    seqs = {"image": 0, "pose": 0}
    found = []
    for number, (stream, stamp) in enumerate(order):
        aligner.push(stream, Entry(stamp * MS, seq=seqs[stream]))
        seqs[stream] += 1
        while (firing := aligner.poll()) is not None:
            found.append((number, firing))
    return found


def arrival() -> str:
    drawing = Drawing(1000, 430)
    drawing.text(20, 30, "Arrival decides when a firing happens, never what it is given", size=17)
    colors = {"image": BLUE, "pose": GREEN}
    for row, (name, order) in enumerate(ORDERS.items()):
        y = 62 + 122 * row
        drawing.text(20, y + 20, name, size=14)
        for number, (stream, stamp) in enumerate(order):
            drawing.box(150 + 118 * number, y, 96, 30, colors[stream])
            drawing.text(198 + 118 * number, y + 20, f"{stream} {stamp}", colors[stream], size=13, anchor="middle")
        at = {number: [f for n, f in decided(order) if n == number] for number, _ in decided(order)}
        for number, firings in at.items():
            drawing.line(198 + 118 * number, y + 30, 198 + 118 * number, y + 52, arrow=True)
            for k, firing in enumerate(firings):
                given = dict(entries_of(firing))
                words = f"t = {given['image']}: pose {given['pose']}"
                drawing.box(146 + 118 * number, y + 54 + 30 * k, 104, 26, INK, fill="#eef2fb")
                drawing.text(198 + 118 * number, y + 72 + 30 * k, words, size=12, anchor="middle")
    drawing.line(150, 400, 970, 400, arrow=True)
    drawing.text(970, 420, "order of arrival (wall clock)", size=12, anchor="end")
    return drawing.svg()


# One firing


def firing() -> str:
    drawing = Drawing(1000, 520)
    columns = {"producer": 90, "aligner": 290, "operator": 480, "firing log": 670, "subscribers": 870}
    drawing.text(20, 30, "One firing, in the process of the operator", size=17)
    for name, at in columns.items():
        drawing.box(at - 65, 48, 130, 32, INK, fill="#eef2fb")
        drawing.text(at, 69, name, anchor="middle")
        drawing.line(at, 80, at, 500, FAINT, width=1, dashes="4 4")
    steps = [
        ("producer", "aligner", "messages and frontiers, in any order"),
        ("aligner", "aligner", "decides: timestamp t and its messages"),
        ("aligner", "subscribers", "frontier t − 1, before a call that takes long"),
        ("aligner", "operator", "seeds the generators, calls process()"),
        ("operator", "operator", "returns messages by port"),
        ("operator", "firing log", "record: inputs by reference, outputs by digest"),
        ("firing log", "firing log", "kept in memory that outlives the process"),
        ("operator", "subscribers", "messages: no message without a record"),
    ]
    for number, (start, end, words) in enumerate(steps):
        y = 118 + 48 * number
        a, b = columns[start], columns[end]
        if start == end:
            drawing.dot(a, y, BLUE, radius=4)
            drawing.text(a + 12, y + 5, f"{number + 1}. {words}", size=13)
        else:
            drawing.line(a, y, b, y, arrow=True)
            drawing.text((a + b) / 2, y - 7, f"{number + 1}. {words}", size=13, anchor="middle")
    return drawing.svg()


# Processes


def processes() -> str:
    drawing = Drawing(1000, 470)
    drawing.text(20, 30, "The processes of a run", size=17)
    drawing.box(330, 50, 170, 44, INK, fill="#eef2fb")
    drawing.text(415, 77, "supervisor", anchor="middle")
    drawing.box(600, 50, 170, 44, INK, fill="#eef2fb")
    drawing.text(685, 77, "nursery", anchor="middle")
    drawing.line(500, 72, 600, 72, arrow=True)
    drawing.text(550, 62, "fork", size=12, anchor="middle")
    places = {"source": 60, "detector": 280, "odometry": 500}
    for name, x in places.items():
        drawing.box(x, 200, 170, 60, BLUE)
        drawing.text(x + 85, 226, f"process '{name}'", BLUE, anchor="middle")
        drawing.text(x + 85, 246, "operators, one thread", FAINT, size=12, anchor="middle")
        drawing.line(415, 94, x + 85, 200, FAINT, dashes="5 4")
    drawing.text(60, 110, "control channel: a socket pair each;", FAINT, size=12)
    drawing.text(60, 126, "carries progress and commands, no data", FAINT, size=12)
    for name, x, words in (("@recorder", 390, "FILE.mcap"), ("@view", 610, "FILE.rrd")):
        drawing.box(x, 340, 150, 50, GREEN)
        drawing.text(x + 75, 362, name, GREEN, anchor="middle")
        drawing.text(x + 75, 380, "takes everything", FAINT, size=12, anchor="middle")
        drawing.line(x + 75, 390, x + 75, 430, GREEN, arrow=True)
        drawing.text(x + 75, 448, words, anchor="middle")
    drawing.line(60, 300, 760, 300, INK, width=5)
    drawing.text(60, 324, "rings in shared memory", size=13)
    drawing.text(60, 342, "in order; only a stalled reader of a live run loses any", FAINT, size=12)
    for x in places.values():
        drawing.line(x + 75, 260, x + 75, 298, arrow=True)
        drawing.line(x + 95, 298, x + 95, 260, arrow=True)
    for x in (465, 685):
        drawing.line(x, 302, x, 340, arrow=True)
    drawing.box(800, 200, 170, 190, ORANGE, dashes="6 4")
    drawing.text(885, 226, "tools that attach", ORANGE, anchor="middle")
    for number, words in enumerate(("viewer", "echo, hz, top", "param")):
        drawing.text(885, 262 + 26 * number, words, anchor="middle")
    drawing.text(885, 352, "taps: copies that", FAINT, size=12, anchor="middle")
    drawing.text(885, 368, "may be skipped", FAINT, size=12, anchor="middle")
    drawing.line(760, 300, 800, 300, ORANGE, dashes="5 4", arrow=True)
    return drawing.svg()


def machines() -> str:
    drawing = Drawing(1000, 400)
    drawing.text(20, 30, "One graph on two machines", size=17)
    for x, width, name in ((20, 380, "robot: dataflow join"), (520, 460, "laptop: dataflow run")):
        drawing.box(x, 50, width, 330, FAINT, dashes="6 4")
        drawing.text(x + 16, 76, name, FAINT)
    drawing.box(40, 100, 150, 50, INK, fill="#eef2fb")
    drawing.text(115, 130, "agent", anchor="middle")
    drawing.box(780, 100, 170, 50, INK, fill="#eef2fb")
    drawing.text(865, 130, "supervisor", anchor="middle")
    for x, y, name in ((40, 230, "camera"), (40, 310, "imu"), (780, 230, "odometry")):
        drawing.box(x, y, 150, 46, BLUE)
        drawing.text(x + 75, y + 28, name, BLUE, anchor="middle")
    drawing.box(780, 310, 150, 46, GREEN)
    drawing.text(855, 338, "@recorder", GREEN, anchor="middle")
    for x, label in ((270, "gate"), (560, "@link")):
        drawing.box(x, 100, 110, 256, VIOLET)
        drawing.text(x + 55, 180, label, VIOLET, anchor="middle")
    drawing.text(615, 200, "gate, keys", FAINT, size=12, anchor="middle")
    drawing.line(190, 125, 270, 125, FAINT, dashes="5 4", arrow=True)
    drawing.line(670, 125, 780, 125, FAINT, dashes="5 4", arrow=True)
    drawing.line(115, 150, 115, 230, FAINT, dashes="5 4")
    drawing.text(200, 116, "control", FAINT, size=12)
    drawing.text(690, 116, "control", FAINT, size=12)
    for y in (253, 333):
        drawing.line(190, y, 270, y, arrow=True)
        drawing.line(670, y, 780, y, arrow=True)
    drawing.text(206, 245, "ring", size=12)
    drawing.text(700, 245, "ring", size=12)
    drawing.line(380, 230, 560, 230, VIOLET, width=5)
    drawing.text(470, 216, "Zenoh, TLS", VIOLET, anchor="middle")
    drawing.text(466, 252, "numbered frames,", FAINT, size=12, anchor="middle")
    drawing.text(466, 268, "each stream once", FAINT, size=12, anchor="middle")
    return drawing.svg()


def terminal(command: str, below: str) -> str:
    """A terminal of the tutorial on a failure: a command of the page, and the output that the page shows below it."""
    page = (HERE.parent / "yesterdays-drive.md").read_text(encoding="utf-8")
    command = next(line for line in page.splitlines() if line.startswith(command))
    output = page.split(f"{command}\n", 1)[1].split("```text\n", 1)[1].split("```", 1)[0]
    lines = [f"$ {command}", *output.splitlines()]
    width, height = 8 * max(map(len, lines)) + 32, 19 * len(lines) + 30
    colors = {"$": "#8fd18f", "not as": "#ff8f7f", "differs": "#ff8f7f", below: "#ffd479"}
    drawn = [
        f'<text x="16" y="{30 + 19 * k}" xml:space="preserve" '
        f'fill="{next((c for part, c in colors.items() if part in line), "#d8dde6")}">{escape(line)}</text>'
        for k, line in enumerate(lines)
    ]
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        'font-family="Menlo, Consolas, DejaVu Sans Mono, monospace" font-size="13">\n'
        f'<rect width="{width}" height="{height}" rx="8" fill="#181b21"/>\n'
    )
    return head + "\n".join(drawn) + "\n</svg>\n"


PICTURES = {
    "terminal_call.svg": lambda: terminal('dataflow debug drive.mcap brake --do "until', "before"),
    "terminal_proof.svg": lambda: terminal("dataflow debug drive.mcap brake --do diff", "no call"),
    "time.svg": time,
    "arrival.svg": arrival,
    "firing.svg": firing,
    "processes.svg": processes,
    "machines.svg": machines,
}

if __name__ == "__main__":
    for name, draw in PICTURES.items():
        (HERE / name).write_text(draw(), encoding="utf-8")
