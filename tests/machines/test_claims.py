"""A machine is the agent that came first, while it is there: what a hello calls for."""

from __future__ import annotations

from dataflow.machines.hub import Claims
from dataflow.machines.pipe import AWAY_AFTER

LONG = AWAY_AFTER + 1


def test_an_agent_without_a_run_is_offered_one_and_another_of_its_name_gets_nothing() -> None:
    claims = Claims("run")
    assert claims.answer("robot", b"1", "", None, 0.0) == "offer"
    assert claims.answer("robot", b"2", "", None, 0.1) == "another"
    assert claims.answer("robot", b"1", "run", 0.1, 0.2) == ""
    assert claims.answer("robot", b"2", "", 0.1, LONG) == "another"
    assert claims.answer("arm", b"3", "former", None, 0.0) == "busy"


def test_an_agent_that_left_the_run_or_was_started_anew_is_noticed() -> None:
    claims = Claims("run")
    claims.answer("robot", b"1", "", None, 0.0)
    assert claims.answer("robot", b"1", "run", LONG, 40.0) == ""  # a long stall: it goes on
    assert claims.answer("robot", b"1", "", 0.1, 41.0) == "offer"  # said before it began
    assert claims.answer("robot", b"1", "", LONG, 42.0) == "anew"
    assert claims.answer("robot", b"1", "next", LONG, 43.0) == "anew"
    assert claims.answer("robot", b"2", "", LONG, 44.0) == "anew"


def test_the_claim_of_an_agent_that_is_gone_before_it_joined_lapses() -> None:
    claims = Claims("run")
    claims.answer("robot", b"1", "", None, 0.0)
    assert claims.answer("robot", b"2", "", None, LONG) == "offer"
    assert claims.answer("robot", b"1", "", None, LONG + 0.1) == "another"
