#pragma once

#include "common/backend.h"
#include "rollout/accumulate.h"
#include "rollout/survey.h"

#define MPM_ROLLOUT_KERNELS(PLAIN, ORDERED, SIZE) \
  PLAIN(survey, SurveyArguments)                  \
  PLAIN(accumulate, AccumulateArguments)          \
  PLAIN(accumulate_slots, AccumulateSlotsArguments)
MPM_BACKEND_KERNELS(MPM_ROLLOUT_KERNELS)
