#pragma once

#include "common/backend.h"
#include "rollout/survey.h"

#define MPM_ROLLOUT_KERNELS(PLAIN, ORDERED, SIZE) PLAIN(survey, SurveyArguments)
MPM_BACKEND_KERNELS(MPM_ROLLOUT_KERNELS)
