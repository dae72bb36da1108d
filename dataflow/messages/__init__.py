"""Message types and their conventions, one module per family."""

from dataflow.messages.base import Message, MessageError, array, message_type, message_types, scalar

__all__ = ["Message", "MessageError", "array", "message_type", "message_types", "scalar"]
