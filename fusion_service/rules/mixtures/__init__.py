"""Fusion of Gaussian mixtures f_i = sum_c alpha_ic N(m_ic, P_ic), any number of sources at once.

Every file here is one rule and declares `RULE = MixtureRule(...)`; `base` is what they share, `face` what callers see.
A rule for Gaussians, of `RULES` and not here, is applied to the sources' moments; the result has one component.

All rules take all sources in one step, or (`ici`, `ei`) in the canonical order of `chain`: the order of arrival does
not matter. Weights are None (the `criterion` decides), "uniform", or given.
"""

from fusion_service.rules.mixtures.face.fusing import MIXTURE_RULES, fuse_mixtures, fuse_mixtures_last

__all__ = ["MIXTURE_RULES", "fuse_mixtures", "fuse_mixtures_last"]
