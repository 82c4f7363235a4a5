"""Recorded returns and truth from files, each sensor with its own local tracker."""
