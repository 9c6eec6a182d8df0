/* Reads of a record's field, of a module's name and of a float in the compiled modules.

Each place in the code remembers the version of the object's type and the field's offset, as CPython's interpreter does (LOAD_ATTR_SLOT),
and the name: that of `getattr` may be another one each time. mypyc searches the type for the name at every read, which made up a fifth of a
control tick. A changed type has another version.
*/
#if defined(__GNUC__) && !defined(Py_GIL_DISABLED) && __has_include("CPy.h")
#include <Python.h>
#include <structmember.h>
#include "CPy.h"

typedef struct {
    PyObject *name; /* owned, so that no other string has its address */
    unsigned int version;
    Py_ssize_t offset; /* 0 if the place has not read a field yet: an object begins with its reference count */
} CompanionField;

static PyObject *companion_find_field(PyObject *object, PyObject *name, CompanionField *field) {
    PyTypeObject *type = Py_TYPE(object);
    PyObject *value = PyObject_GetAttr(object, name);
    PyObject *member = _PyType_Lookup(type, name);
    if (value != NULL && member != NULL && Py_IS_TYPE(member, &PyMemberDescr_Type) &&
        type->tp_getattro == PyObject_GenericGetAttr && PyType_HasFeature(type, Py_TPFLAGS_VALID_VERSION_TAG)) {
        PyMemberDef *found = ((PyMemberDescrObject *)member)->d_member;
        if (found->type == T_OBJECT_EX) {
            Py_INCREF(name);
            Py_XSETREF(field->name, name);
            field->version = type->tp_version_tag;
            field->offset = found->offset;
        }
    }
    return value;
}

static inline PyObject *companion_field(PyObject *object, PyObject *name, CompanionField *field) {
    if (field->name == name && field->offset != 0 && Py_TYPE(object)->tp_version_tag == field->version) {
        PyObject *value = *(PyObject **)((char *)object + field->offset);
        if (value != NULL) {
            return Py_NewRef(value);
        }
    }
    if (PyModule_CheckExact(object)) {
        PyObject *value = PyDict_GetItemWithError(PyModule_GetDict(object), name);
        if (value != NULL) {
            return Py_NewRef(value);
        }
        if (PyErr_Occurred()) {
            return NULL;
        }
    }
    return companion_find_field(object, name, field);
}

static inline double companion_double(PyObject *object) {
    return PyFloat_CheckExact(object) ? PyFloat_AS_DOUBLE(object) : PyFloat_AsDouble(object);
}

#define PyFloat_AsDouble(object) companion_double(object)

#undef CPyObject_GetAttr
#define CPyObject_GetAttr(object, name)                    \
    __extension__({                                        \
        static CompanionField field_here;                  \
        companion_field((object), (name), &field_here);    \
    })
#endif
