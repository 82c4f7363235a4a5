"""Requirement profiles: numbers that a picture must keep to, in TOML, and whether a mission shows that it does."""

from fusion_service.review.profiles.judging import Judged, judge
from fusion_service.review.profiles.profile import Area, Profile, Requirement
from fusion_service.review.profiles.reading import ProfileError, load_profile, shipped

__all__ = ["Area", "Judged", "Profile", "ProfileError", "Requirement", "judge", "load_profile", "shipped"]
