"""The page about faults: tests show each of its rows, and its plan is the one that is shipped and can be followed."""

from __future__ import annotations

import ast
import re
from itertools import islice
from pathlib import Path
from typing import get_args

from dataflow.chaos import faults as kinds
from dataflow.chaos import plan as chaos
from dataflow.graph import load_graph
from dataflow.supervision.core.health import LEVELS

SHOWN_BY = {
    "an operator raises": "operator_that_raises_is_recreated_in_the_same_process",
    "a process crashes": """
        crashed_process_is_replaced_while_the_rest_continues
        frontier_from_a_successor_reveals_messages_lost_of_its_predecessor
        a_late_death_notice_does_not_affect_the_successor
    """,
    "the same operator fails again and again": "restarts_come_to_an_end_and_the_last_cause_is_named",
    "a process fails in `setup()`, or dies while it starts": """
        a_set_up_that_fails_is_tried_again_by_the_policy_until_it_is_used_up
        a_process_that_is_killed_while_starting_is_restarted_by_its_policy
    """,
    "an operator hangs past its `deadline`": """
        an_operator_that_hangs_is_killed_at_its_deadline_and_started_again
        without_a_policy_a_hang_ends_the_run_and_names_operator_and_deadline
    """,
    "an operator without a `deadline` hangs": """
        a_hang_without_a_deadline_ends_the_run_when_too_much_waits_for_it
        a_hang_without_a_deadline_is_ended_by_its_restart_policy
    """,
    "an operator leaks memory": """
        a_process_that_leaks_past_its_limit_is_started_again
        without_a_policy_a_leak_ends_the_run_before_the_machine_does
    """,
    "an operator is slow": "slow_operator_drops_by_policy_without_delaying_others",
    "a process gives no sign of life (stopped, swapped out)": """
        unresponsive_process_is_killed_and_restarted_by_its_policy
        stopped_consumer_is_not_waited_for_and_starts_a_new_backlog
        gap_at_a_consumer_is_counted_as_its_drops
    """,
    "a process lives and takes no messages (a call that holds the interpreter)": """
        stopped_consumer_delays_no_other_process_and_its_loss_is_counted
    """,
    "the whole run or its supervisor pauses (`docker pause`, a suspended laptop, heavy swapping)": """
        pause_of_supervisor_and_others_kills_and_blames_no_process
        a_time_in_which_the_process_was_stopped_is_no_part_of_a_call
    """,
    "the process that starts the others (the nursery) is killed": """
        killed_nursery_fails_the_run_and_leaves_no_process
    """,
    "several faults at random": "a_run_under_faults_of_every_kind_is_verified_in_the_other_placement",
    "a source crashes, or a live source raises (an unplugged camera)": """
        crashed_source_is_restarted_at_the_current_time
        source_that_raises_is_recreated_in_the_same_process
    """,
    "a source stops": """
        a_source_that_stops_is_an_event_in_the_diagnostics
        a_source_that_stops_holds_up_no_other
    """,
    "nothing happens around the robot": "idle_robot_keeps_running",
    "a source is slower than the clock": """
        a_source_behind_the_clock_is_named_at_once_and_at_the_end
        busy_process_is_named_as_the_cause_of_a_late_source
    """,
    "a source floods": "a_flood_is_dropped_where_it_is_too_much_and_counted",
    "a clock jumps back": """
        clock_jump_back_starts_an_incarnation_and_resets_operators
        replay_after_a_clock_jump_back_drops_repeated_stamps_as_late
    """,
    "a clock jumps ahead": """
        clock_jump_ahead_continues_the_incarnation
        a_source_whose_stamps_jumped_far_ahead_is_named
    """,
    "a message has a stamp in the past": """
        past_stamps_and_malformed_outside_messages_are_dropped
    """,
    "the disk is full while recording": """
        a_full_disk_stops_the_recording_until_it_has_room_and_never_the_run
        a_disk_that_is_full_ends_the_run_and_the_recording_stays_readable
        a_recording_that_may_not_grow_ends_the_run_and_stays_readable
    """,
    "the recorder is killed": "killed_recorder_is_replaced_and_the_run_continues",
    "the recorder is stopped or slow": "only_links_to_operators_of_a_live_run_drop",
    "a viewer or `dataflow echo` dies or stops": """
        a_viewer_that_is_killed_is_not_missed
        a_stopped_viewer_costs_nothing_and_loses_nothing
    """,
    "a Zenoh subscriber outside the run is slow or stopped": "slow_outside_subscriber_does_not_delay_the_run",
    "another program publishes on a key of the run, malformed or forged": """
        past_stamps_and_malformed_outside_messages_are_dropped
        forged_ends_frontiers_and_messages_change_nothing
    """,
    "an envelope contradicts its stream": """
        contradicting_envelope_is_ignored_and_counted
    """,
}
"""The faults of the page, with the tests that show the response to each, without `test_`."""


def page(repository: Path) -> str:
    return (repository / "docs" / "faults.md").read_text(encoding="utf-8")


def test_tests_show_the_response_to_every_fault_of_the_page(repository: Path) -> None:
    tables = page(repository).split("## A recording that fails")[0]
    rows = re.findall(r"^\| (?!---)(?!fault \|)([^|]+) \|", tables, re.MULTILINE)
    there = {
        node.name
        for folder in ("runtime", "process", "supervision", "transport", "simulation")
        for file in (repository / "tests" / folder).glob("test_*.py")
        for node in ast.parse(file.read_text(encoding="utf-8")).body
        if isinstance(node, ast.FunctionDef)
    }

    assert rows == list(SHOWN_BY)
    named = [f"test_{name}" for names in SHOWN_BY.values() for name in names.split()]
    assert all(SHOWN_BY.values())
    assert set(named) <= there, set(named) - there


def test_the_plan_on_the_page_is_the_shipped_one_and_has_faults_of_every_kind(repository: Path) -> None:
    plan = repository / "graphs" / "chaos" / "plan.yaml"
    graph = load_graph(repository / "graphs" / "chaos" / "robot.yaml", live=True)

    assert f"```yaml\n{plan.read_text(encoding='utf-8')}```" in page(repository)
    faults = list(islice(chaos.load_plan(plan, graph), 200))
    known = {*kinds.TO_OPERATORS, *kinds.TO_SOURCES, *kinds.TO_PROCESSES, "malformed", "param"}
    assert {fault.kind for fault in faults} == known


def test_every_kind_of_fault_and_every_state_has_a_row(repository: Path) -> None:
    rows = set(re.findall(r"^\| `(\w+)` \|", page(repository), re.MULTILINE))
    entry, _ = get_args(chaos._Entry)
    kinds = {kind for model in get_args(entry) for kind in get_args(model.model_fields["kind"].annotation)}

    assert rows == kinds | set(LEVELS)
