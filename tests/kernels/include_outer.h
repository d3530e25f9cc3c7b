#pragma once
#include "include_inner.h"
#define OUTER (INNER * 100)
