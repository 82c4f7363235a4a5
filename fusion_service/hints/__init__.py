"""What is wrong with what a source sends, and how it is mended, in words for who has to mend it.

Pure functions and one bounded record: `read_finding` of bytes that cannot be read, `number_finding` of densities,
`refusal_finding` of what a centre refuses, and `Listened`, which hears the messages of one source and doubts what
contradicts itself (`doubts`). Service and `sensor-client check` say the same by them.
"""

from fusion_service.hints.finding import Finding
from fusion_service.hints.listening import Listened
from fusion_service.hints.numbers import number_finding
from fusion_service.hints.payload import read_finding
from fusion_service.hints.refusals import refusal_finding
from fusion_service.hints.words import key_finding, near

__all__ = [
    "Finding",
    "Listened",
    "key_finding",
    "near",
    "number_finding",
    "read_finding",
    "refusal_finding",
]
