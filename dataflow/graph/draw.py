"""A graph for people: as a tree in the terminal, and as a Mermaid flowchart."""

from __future__ import annotations

from rich.text import Text
from rich.tree import Tree

from dataflow.graph.model import Graph, Node, input_text

_ARROW = {"in": "-->", "sampled": "-.->", "batch": "==>"}


def tree(graph: Graph) -> Tree:
    """Processes, their operators, and of each its inputs (kind, type, streams) and outputs (type)."""
    grouped = graph.processes()
    title = Text.assemble((graph.name, "bold"), f"  {graph.namespace}  ", (_counts(graph), "dim"))
    root = Tree(title)
    for process, names in grouped.items():
        node = graph.nodes[names[0]]
        where = f" on {node.machine}" * (node.machine is not None) + f" in {node.env}" * (node.env is not None)
        branch = root.add(Text.assemble(("process ", "dim"), (process, "cyan"), (where, "dim")))
        for name in names:
            node = graph.nodes[name]
            label = Text.assemble((name, "bold"), "  ", (node.use, "dim"))
            entry = branch.add(label)
            for line in _ports(graph, node):
                entry.add(line)
    if graph.left_out:
        branch = root.add(Text("left out", style="dim"))
        for name, why in graph.left_out.items():
            branch.add(Text.assemble((name, "bold"), "  ", (why, "dim")))
    return root


def _counts(graph: Graph) -> str:
    processes = len(graph.processes())
    counts = ((len(graph.nodes), "operator"), (len(graph.streams), "stream"))
    others = [f"{number} {word}{'' if number == 1 else 's'}" for number, word in counts]
    return ", ".join([f"{processes} process{'' if processes == 1 else 'es'}", *others])


def _ports(graph: Graph, node: Node) -> list[Text]:
    lines: list[Text] = []
    width = max((len(p) for p in (*node.inputs, *node.outputs)), default=0)
    for name, streams in node.inputs.items():
        port = node.input_port(name)
        taken = (", ".join(graph.relative(s) for s in streams), "") if streams else ("(left out)", "dim")
        typed = (input_text(port), "yellow")
        lines.append(Text.assemble(("in  ", "green"), f"{name:<{width}}  ", typed, " <- ", taken))
    for name, stream in node.outputs.items():
        made = graph.streams[stream]
        typed, extra = (" | ".join(made.types), "yellow"), ("  static" if made.static else "", "dim")
        lines.append(Text.assemble(("out ", "blue"), f"{name:<{width}}  ", typed, extra))
    return lines


def mermaid(graph: Graph) -> str:
    """A Mermaid flowchart: a subgraph per shared process; triggers solid, Sampled dotted, Batch thick."""
    ids = {name: f"n{i}" for i, name in enumerate(graph.nodes)}
    lines = ["flowchart LR"]
    for number, (label, names) in enumerate(graph.processes().items()):
        boxes = [f'{ids[name]}["<b>{name}</b><br/>{graph.nodes[name].use.rpartition(":")[2]}"]' for name in names]
        if len(names) == 1:
            lines.append(f"    {boxes[0]}")
        else:
            lines += [f'    subgraph h{number} ["process {label}"]', *(f"        {box}" for box in boxes), "    end"]
    for edge in graph.edges():
        arrow = _ARROW[graph.nodes[edge.consumer].input_port(edge.input).kind]
        label = f"{edge.port}: {' or '.join(graph.streams[edge.stream].types)}"
        lines.append(f'    {ids[edge.producer]} {arrow}|"{label}"| {ids[edge.consumer]}')
    return "\n".join([*lines, ""])
