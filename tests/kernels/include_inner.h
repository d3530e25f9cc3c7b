#pragma once
#define INNER 7
