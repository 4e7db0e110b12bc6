"""A fit over the whole length goes on from friction that was fitted before."""

import numpy as np
import pytest
from rigs import slide_logs

from nnap_em.explain.diagnosis.context import SearchContext, extend
from nnap_em.explain.diagnosis.hypothesis import Hypothesis


def test_friction_that_is_right_is_gone_on_from(slide_fit):
    data, lines = slide_logs(0), []
    context = SearchContext(slide_fit, {}, data, lines.append)
    state = extend(context, Hypothesis(slide_fit.model, slide_fit.m_step), data.t.shape[1])
    assert len(lines) == 1
    assert np.nanmean(state.top) == pytest.approx(np.nanmean(slide_fit.state.top), abs=0.5)
