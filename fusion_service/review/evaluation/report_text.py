"""The style of the report, and its glossary."""

from __future__ import annotations

__all__ = ["CSS", "WORDS"]

CSS = """
*{box-sizing:border-box}
body{font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif;color:#1b1f24;
background:#fff;margin:0 auto;max-width:1180px;padding:1.2rem 1.2rem 4rem}
h1{font-size:1.7rem;line-height:1.2;margin:.2rem 0 .6rem}
h2{font-size:1.25rem;margin:2.4rem 0 .6rem;padding-top:.6rem;border-top:2px solid #1b1f24}
h3{font-size:1.02rem;margin:1.4rem 0 .4rem}
p{margin:.5rem 0;max-width:70ch}
.lead{font-size:1.12rem;border-left:5px solid #0072b2;background:#f1f6fa;padding:.7rem 1rem;max-width:none}
.note{color:#59636e;font-size:.9rem}
dl.facts{display:grid;grid-template-columns:max-content 1fr;gap:.15rem 1rem;font-size:.92rem;margin:.8rem 0}
dl.facts dt{color:#59636e}
dl.facts dd{margin:0;overflow-wrap:anywhere}
.scroll{overflow-x:auto;margin:.6rem 0}
table{border-collapse:collapse;font-size:.9rem;font-variant-numeric:tabular-nums}
th,td{padding:.28rem .7rem;text-align:right;border-bottom:1px solid #d9dee3;white-space:nowrap}
th{font-weight:600;color:#40474e;border-bottom:2px solid #9aa3ab}
th:first-child,td:first-child,td.left,th.left{text-align:left}
td.wrap{white-space:normal;min-width:17rem}
tr.fused td{font-weight:600}
tr.fused td:not([class]){background:#f5f5f5}
td.best{background:#dff2e8;font-weight:600}
td.low{background:#dceaf6}
td.high{background:#fbdcd0}
td.good{background:#dff2e8}
td.none{color:#9aa3ab}
.charts{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,430px),1fr));gap:1.4rem 1.6rem}
figure{margin:0;break-inside:avoid}
figure svg,figure img{width:100%;height:auto;display:block}
figcaption{font-size:.88rem;color:#40474e;margin-top:.2rem}
.map{margin:.8rem 0}
.map img{min-width:660px}
dl.words dt{font-weight:600;margin-top:.7rem}
dl.words dd{margin:0;max-width:75ch}
.swatch{display:inline-block;width:1em;height:1em;vertical-align:-.12em;margin:0 .3em 0 .8em;border:1px solid #c5ccd3}
@media (max-width:600px){body{padding:.8rem .8rem 3rem;font-size:15px}dl.facts{grid-template-columns:1fr}
dl.facts dd{margin-bottom:.4rem}th,td{padding:.25rem .45rem}}
@media print{body{max-width:none;padding:0;font-size:10.5pt}h2,h3,dt{break-after:avoid}table,figure{break-inside:avoid}
.scroll{overflow:visible}table{font-size:8pt}th,td{padding:.15rem .35rem}.map img{min-width:0}
.charts{grid-template-columns:1fr 1fr;gap:.8rem}*{-webkit-print-color-adjust:exact;print-color-adjust:exact}}
"""

WORDS = {
    "RMSE": (
        "Root mean square error of position of the tracks assigned to a target, m. Lower is better. Look at it "
        "together with what is missed: a source that follows only near targets has a small RMSE."
    ),
    "GOSPA": (
        "One distance between all true targets and all tracks: squared errors of the assigned pairs, and half the "
        "squared cut-off for each target missed and each false track; its parts say which fault weighs most. "
        "Depends on the cut-off: compare only numbers with the same one."
    ),
    "OSPA": (
        "Like GOSPA, but per target: at most the cut-off, whatever the number of targets. It cannot tell missed "
        "from false."
    ),
    "OSPA(2)": (
        "OSPA between whole tracks and whole paths over a window of scored times: swapped and broken tracks cost, "
        "which OSPA does not see."
    ),
    "NEES, ANEES": (
        "The squared error in units of what the covariance says, over the dimension, and its average. 1: the "
        "covariances say the truth. Above the bounds: overconfident, do not trust the ellipses. Below: cautious, "
        "the ellipses are larger than need be. The bounds suppose independent errors; errors along a track are "
        "not, so values a little outside mean little."
    ),
    "Followed": ("Targets that had a track within the cut-off for at least half of the time they existed."),
    "Identity switches": ("How often a target's track was replaced by another one. 0 is ideal."),
    "Complete, spurious, ambiguity": (
        "SIAP: the share of targets with a track; the share of tracks with no target within the cut-off; tracks "
        "per followed target (1 is ideal, more are doubles). A track belongs to the nearest target within the "
        "cut-off."
    ),
    "PA, VA": ("SIAP positional and velocity accuracy: mean error of the tracks that belong to a target, m and m/s."),
    "Changes per hour, longest": (
        "SIAP: how often a target's track number changed per hour of being followed; the share of a target's life "
        "that its longest unbroken track covers."
    ),
    "Time to confirm": (
        "From when a target is where a source covers it, or has a local track, to its first confirmed fused "
        "track; no finer than the scored times."
    ),
    "Sources against each other": (
        "Needs no truth. The squared distance of two local tracks of one object in units of both covariances, "
        "over the dimension. 1: as their covariances say. Above: covariances too small, a bias, or wrong links. "
        "Below: covariances too large, or errors that are correlated, which naive fusion must not be used for."
    ),
    "Links against the fusion of the others": (
        "The same of one source against the fusion of all others at the step. That fusion is cautious, so below 1 "
        "is usual; a source far above the others is biased or overconfident."
    ),
    "Delays": (
        "Sent to received: bus and network, by the clocks of both ends. Time of the tracks to sent: how old data "
        "are when they leave. Time of the step to published: the centre's wait for late data, and its work. Last "
        "message to picture: the centre's work alone. Not told where the mission did not run in real time."
    ),
}
"""What each number means and how to read it."""
