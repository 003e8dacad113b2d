"""Recover the motion of every particle from that of the samples: stage 6, one file per kind."""

from giorom.fields.choice import FieldConfig, FieldKind, build_field
from giorom.fields.contract import Field, FieldDecoder

__all__ = ["Field", "FieldConfig", "FieldDecoder", "FieldKind", "build_field"]
