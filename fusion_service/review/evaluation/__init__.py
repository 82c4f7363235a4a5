"""How good the tracks of a mission were: against truth, and without any; in words, as JSON and on a page."""

from fusion_service.review.evaluation.assess import Assessment, Evaluation, NothingToScoreError, assess, evaluate
from fusion_service.review.evaluation.logbook import Logbook
from fusion_service.review.evaluation.scoring import METRICS, Scores
from fusion_service.review.evaluation.tables import format_table

__all__ = [
    "METRICS",
    "Assessment",
    "Evaluation",
    "Logbook",
    "NothingToScoreError",
    "Scores",
    "assess",
    "evaluate",
    "format_table",
]
