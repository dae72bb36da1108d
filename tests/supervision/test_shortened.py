"""What is left of the stacks in a process's last words."""

from __future__ import annotations

from dataflow.supervision.core.stack_traces import shortened

LISTENER = [
    "Thread 0x00007fe4ecbff6c0 (most recent call first):",
    '  File "/there/dataflow/process/channel.py", line 80 in _read',
    '  File "/there/dataflow/supervision/process_main.py", line 37 in _listen',
    '  File "/usr/lib/python3.11/threading.py", line 982 in run',
    "",
]
ENGINE = [
    '  File "/there/dataflow/execution/calls.py", line 40 in setup',
    '  File "/there/dataflow/supervision/process_main.py", line 150 in main',
    '  File "<frozen runpy>", line 88 in _run_code',
]


def test_frames_of_the_operator_are_left_and_those_of_the_engine_are_not() -> None:
    header = "Current thread 0x00007fe4f5c06b80 (most recent call first):"
    imported = [
        '  File "/site-packages/open3d/__init__.py", line 79 in <module>',
        '  File "<frozen importlib._bootstrap>", line 1176 in _find_and_load',
        '  File "/mine/robot.py", line 7 in setup',
    ]

    assert shortened(["hello", *LISTENER, header, *imported, *ENGINE]) == ["hello", header, imported[0], imported[2]]


def test_a_thread_that_is_in_no_call_of_an_operator_is_left_whole() -> None:
    other = [
        "Thread 0x00007fe4ecbff6c1 (most recent call first):",
        '  File "/there/dataflow/transport/ring.py", line 80 in read',
        '  File "/usr/lib/python3.11/threading.py", line 982 in run',
    ]

    assert shortened([*other, "and on it goes"]) == [*other, "and on it goes"]


def test_words_without_stacks_and_a_traceback_stay_as_they_are() -> None:
    words = [
        "Traceback (most recent call last):",
        '  File "/mine/robot.py", line 7, in setup',
        "    wait()",
        "ValueError: no",
        "",
        "the end",
    ]

    assert shortened(words) == words


def test_a_call_that_waits_in_the_engine_itself_is_left_whole() -> None:
    header = "Current thread 0x00007fe4f5c06b80 (most recent call first):"

    assert shortened([header, *ENGINE]) == [header, *ENGINE[:2]]


def test_truncated_stack_keeps_only_the_frames_of_operators() -> None:
    mine = '  File "/mine/robot.py", line 7 in setup'

    assert shortened([mine, *ENGINE, "", "and on"]) == [mine, "", "and on"]
    assert shortened([*ENGINE[1:], "", "and on"]) == ["", "and on"]
