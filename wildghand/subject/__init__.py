"""The subject's own hand: the template bent to the outlines of a clip's masks before the fit."""

from wildghand.subject.fit_subject import fit_subject
from wildghand.subject.shape import SubjectShape

__all__ = ["SubjectShape", "fit_subject"]
