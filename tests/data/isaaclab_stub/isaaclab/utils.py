"""Configurations."""

from dataclasses import dataclass as configclass

__all__ = ["configclass"]
